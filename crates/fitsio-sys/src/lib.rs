//! The functions, types and numbers of [cfitsio](https://heasarc.gsfc.nasa.gov/fitsio/) that the crate `fitsio` and shearq call, as
//! `fitsio.h` declares them: those of fitsio-sys 0.5.7, which bindgen made (see README.md).

#![allow(
    non_camel_case_types,
    missing_debug_implementations,
    reason = "names and types of cfitsio"
)]

use std::os::raw::{
    c_char, c_int, c_long, c_longlong, c_schar, c_short, c_uchar, c_uint, c_ulong, c_ulonglong,
    c_ushort, c_void,
};

// Its functions are called by cfitsio.
#[cfg(feature = "fitsio-src")]
use libz_rs_sys as _;

pub type LONGLONG = c_longlong;
pub type ULONGLONG = c_ulonglong;

/// An open file, whose fields only cfitsio uses.
#[repr(C)]
#[derive(Debug, Copy, Clone)]
pub struct fitsfile {
    pub _bindgen_opaque_blob: [u64; 2usize],
}

pub const CFITSIO_MINOR: u32 = 6;
pub const CFITSIO_MAJOR: u32 = 4;
pub const FLEN_VALUE: u32 = 71;
pub const FLEN_COMMENT: u32 = 73;
pub const TBIT: u32 = 1;
pub const TBYTE: u32 = 11;
pub const TSBYTE: u32 = 12;
pub const TLOGICAL: u32 = 14;
pub const TSTRING: u32 = 16;
pub const TUSHORT: u32 = 20;
pub const TSHORT: u32 = 21;
pub const TUINT: u32 = 30;
pub const TINT: u32 = 31;
pub const TULONG: u32 = 40;
pub const TLONG: u32 = 41;
pub const TFLOAT: u32 = 42;
pub const TULONGLONG: u32 = 80;
pub const TLONGLONG: u32 = 81;
pub const TDOUBLE: u32 = 82;
pub const TCOMPLEX: u32 = 83;
pub const TDBLCOMPLEX: u32 = 163;
pub const IMAGE_HDU: u32 = 0;
pub const BINARY_TBL: u32 = 2;
pub const READONLY: u32 = 0;
pub const READWRITE: u32 = 1;
pub const CASESEN: u32 = 1;
pub const CASEINSEN: u32 = 0;

unsafe extern "C" {
    pub fn ffclos(fptr: *mut fitsfile, status: *mut c_int) -> c_int;
    pub fn ffcmsg();
    pub fn ffcopy(
        infptr: *mut fitsfile,
        outfptr: *mut fitsfile,
        morekeys: c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffcrim(
        fptr: *mut fitsfile,
        bitpix: c_int,
        naxis: c_int,
        naxes: *mut c_long,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffcrtb(
        fptr: *mut fitsfile,
        tbltype: c_int,
        naxis2: LONGLONG,
        tfields: c_int,
        ttype: *mut *mut c_char,
        tform: *mut *mut c_char,
        tunit: *mut *mut c_char,
        extname: *const c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffdcol(fptr: *mut fitsfile, numcol: c_int, status: *mut c_int) -> c_int;
    pub fn ffdhdu(fptr: *mut fitsfile, hdutype: *mut c_int, status: *mut c_int) -> c_int;
    pub fn ffdkopn(
        fptr: *mut *mut fitsfile,
        filename: *const c_char,
        iomode: c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffflmd(fptr: *mut fitsfile, filemode: *mut c_int, status: *mut c_int) -> c_int;
    pub fn ffflnm(fptr: *mut fitsfile, filename: *mut c_char, status: *mut c_int) -> c_int;
    pub fn fffree(value: *mut c_void, status: *mut c_int) -> c_int;
    pub fn ffgbcl(
        fptr: *mut fitsfile,
        colnum: c_int,
        ttype: *mut c_char,
        tunit: *mut c_char,
        dtype: *mut c_char,
        repeat: *mut c_long,
        tscal: *mut f64,
        tzero: *mut f64,
        tnull: *mut c_long,
        tdisp: *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcdw(
        fptr: *mut fitsfile,
        colnum: c_int,
        width: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcno(
        fptr: *mut fitsfile,
        casesen: c_int,
        templt: *mut c_char,
        colnum: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcv(
        fptr: *mut fitsfile,
        datatype: c_int,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: *mut c_void,
        array: *mut c_void,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcvb(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: c_uchar,
        array: *mut c_uchar,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcvd(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: f64,
        array: *mut f64,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcve(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: f32,
        array: *mut f32,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcvi(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: c_short,
        array: *mut c_short,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcvj(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: c_long,
        array: *mut c_long,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcvjj(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: LONGLONG,
        array: *mut LONGLONG,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcvk(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: c_int,
        array: *mut c_int,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcvl(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: c_char,
        array: *mut c_char,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcvs(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: *mut c_char,
        array: *mut *mut c_char,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcvsb(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: c_schar,
        array: *mut c_schar,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcvui(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: c_ushort,
        array: *mut c_ushort,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcvuj(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: c_ulong,
        array: *mut c_ulong,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcvujj(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: ULONGLONG,
        array: *mut ULONGLONG,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcvuk(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: c_uint,
        array: *mut c_uint,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgcx(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstbit: LONGLONG,
        nbits: LONGLONG,
        larray: *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgerr(status: c_int, errtext: *mut c_char);
    pub fn ffghadll(
        fptr: *mut fitsfile,
        headstart: *mut LONGLONG,
        datastart: *mut LONGLONG,
        dataend: *mut LONGLONG,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffghdn(fptr: *mut fitsfile, chdunum: *mut c_int) -> c_int;
    pub fn ffghdt(fptr: *mut fitsfile, exttype: *mut c_int, status: *mut c_int) -> c_int;
    pub fn ffgidm(fptr: *mut fitsfile, naxis: *mut c_int, status: *mut c_int) -> c_int;
    pub fn ffgidt(fptr: *mut fitsfile, imgtype: *mut c_int, status: *mut c_int) -> c_int;
    pub fn ffgiet(fptr: *mut fitsfile, imgtype: *mut c_int, status: *mut c_int) -> c_int;
    pub fn ffgisz(
        fptr: *mut fitsfile,
        nlen: c_int,
        naxes: *mut c_long,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgiszll(
        fptr: *mut fitsfile,
        nlen: c_int,
        naxes: *mut LONGLONG,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgkls(
        fptr: *mut fitsfile,
        keyname: *const c_char,
        value: *mut *mut c_char,
        comm: *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgknm(
        card: *mut c_char,
        name: *mut c_char,
        length: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgky(
        fptr: *mut fitsfile,
        datatype: c_int,
        keyname: *const c_char,
        value: *mut c_void,
        comm: *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgkyd(
        fptr: *mut fitsfile,
        keyname: *const c_char,
        value: *mut f64,
        comm: *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgkye(
        fptr: *mut fitsfile,
        keyname: *const c_char,
        value: *mut f32,
        comm: *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgkyj(
        fptr: *mut fitsfile,
        keyname: *const c_char,
        value: *mut c_long,
        comm: *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgkyjj(
        fptr: *mut fitsfile,
        keyname: *const c_char,
        value: *mut LONGLONG,
        comm: *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgkyl(
        fptr: *mut fitsfile,
        keyname: *const c_char,
        value: *mut c_int,
        comm: *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgkys(
        fptr: *mut fitsfile,
        keyname: *const c_char,
        value: *mut c_char,
        comm: *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgmsg(err_message: *mut c_char) -> c_int;
    pub fn ffgncl(fptr: *mut fitsfile, ncols: *mut c_int, status: *mut c_int) -> c_int;
    pub fn ffgnrw(fptr: *mut fitsfile, nrows: *mut c_long, status: *mut c_int) -> c_int;
    pub fn ffgnrwll(fptr: *mut fitsfile, nrows: *mut LONGLONG, status: *mut c_int) -> c_int;
    pub fn ffgpv(
        fptr: *mut fitsfile,
        datatype: c_int,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        nulval: *mut c_void,
        array: *mut c_void,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgsv(
        fptr: *mut fitsfile,
        datatype: c_int,
        blc: *mut c_long,
        trc: *mut c_long,
        inc: *mut c_long,
        nulval: *mut c_void,
        array: *mut c_void,
        anynul: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffgtclll(
        fptr: *mut fitsfile,
        colnum: c_int,
        typecode: *mut c_int,
        repeat: *mut LONGLONG,
        width: *mut LONGLONG,
        status: *mut c_int,
    ) -> c_int;
    pub fn fficol(
        fptr: *mut fitsfile,
        numcol: c_int,
        ttype: *mut c_char,
        tform: *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffinit(fptr: *mut *mut fitsfile, filename: *const c_char, status: *mut c_int) -> c_int;
    pub fn ffmahd(
        fptr: *mut fitsfile,
        hdunum: c_int,
        exttype: *mut c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffmnhd(
        fptr: *mut fitsfile,
        exttype: c_int,
        hduname: *mut c_char,
        hduvers: c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffopen(
        fptr: *mut *mut fitsfile,
        filename: *const c_char,
        iomode: c_int,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffpcl(
        fptr: *mut fitsfile,
        datatype: c_int,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        array: *mut c_void,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffpcls(
        fptr: *mut fitsfile,
        colnum: c_int,
        firstrow: LONGLONG,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        array: *mut *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffpclx(
        fptr: *mut fitsfile,
        colnum: c_int,
        frow: LONGLONG,
        fbit: c_long,
        nbit: c_long,
        larray: *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffphps(
        fptr: *mut fitsfile,
        bitpix: c_int,
        naxis: c_int,
        naxes: *mut c_long,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffpky(
        fptr: *mut fitsfile,
        datatype: c_int,
        keyname: *const c_char,
        value: *mut c_void,
        comm: *const c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffpkyd(
        fptr: *mut fitsfile,
        keyname: *const c_char,
        value: f64,
        decim: c_int,
        comm: *const c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffpkye(
        fptr: *mut fitsfile,
        keyname: *const c_char,
        value: f32,
        decim: c_int,
        comm: *const c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffpkys(
        fptr: *mut fitsfile,
        keyname: *const c_char,
        value: *const c_char,
        comm: *const c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffppr(
        fptr: *mut fitsfile,
        datatype: c_int,
        firstelem: LONGLONG,
        nelem: LONGLONG,
        array: *mut c_void,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffpss(
        fptr: *mut fitsfile,
        datatype: c_int,
        fpixel: *mut c_long,
        lpixel: *mut c_long,
        array: *mut c_void,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffpsvc(
        card: *mut c_char,
        value: *mut c_char,
        comm: *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffrsim(
        fptr: *mut fitsfile,
        bitpix: c_int,
        naxis: c_int,
        naxes: *mut c_long,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffsnul(
        fptr: *mut fitsfile,
        colnum: c_int,
        nulstring: *mut c_char,
        status: *mut c_int,
    ) -> c_int;
    pub fn ffthdu(fptr: *mut fitsfile, nhdu: *mut c_int, status: *mut c_int) -> c_int;
    pub fn fits_is_compressed_image(fptr: *mut fitsfile, status: *mut c_int) -> c_int;
}

pub use ffflnm as fits_file_name;

/// The version of cfitsio whose `fitsio.h` is declared here.
pub struct CfitsioVersion {
    pub minor: u32,
    pub major: u32,
}

impl std::fmt::Display for CfitsioVersion {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}.{}", self.major, self.minor)
    }
}

pub fn cfitsio_version() -> CfitsioVersion {
    CfitsioVersion {
        minor: CFITSIO_MINOR,
        major: CFITSIO_MAJOR,
    }
}
