//! Compiles the cfitsio of this folder, or finds the system's.

fn main() {
    println!("cargo::rerun-if-changed=cfitsio");
    #[cfg(feature = "fitsio-src")]
    compile();
    #[cfg(not(feature = "fitsio-src"))]
    if let Err(error) = pkg_config::Config::new()
        // The oldest with which the tests passed.
        .atleast_version("3.49")
        .probe("cfitsio")
    {
        panic!("no cfitsio of the system is found: {error}");
    }
}

#[cfg(feature = "fitsio-src")]
fn compile() {
    let mut sources: Vec<_> = std::fs::read_dir("cfitsio")
        .expect("the folder of sources")
        .map(|entry| entry.expect("an entry of it").path())
        .filter(|path| path.extension().is_some_and(|ending| ending == "c"))
        .collect();
    sources.sort();
    // Without HAVE_NET_SERVICES, HAVE_SHMEM_SERVICES and HAVE_GSIFTP there are no drivers for them, and without _REENTRANT no
    // locks, because shearq calls cfitsio from one thread at a time.
    cc::Build::new()
        .files(sources)
        .include("zlib")
        .define("HAVE_UNISTD_H", None)
        .define("HAVE_FTRUNCATE", None)
        // Its warnings are for its authors.
        .warnings(false)
        .flag_if_supported("-w")
        .compile("cfitsio");
}
