//! Which columns of a catalogue are what.

use std::collections::BTreeMap;
use std::path::Path;

use shearq_files::{FileError, names_of};

/// How ellipticities become shears.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shapes {
    /// They are shears (1 − q)/(1 + q).
    Shear,
    /// Distortions (1 − q²)/(1 + q²), each converted to a shear. Moduli above 1 have none and are left out.
    Converted,
    /// Distortions, whose mean is divided by 2ℛ. ℛ = 1 − ⟨w e_rms²⟩/⟨w⟩ with the standard deviation e_rms of a component
    /// (Bernstein & Jarvis 2002, equation 5.33; Mandelbaum et al. 2018, equation 10).
    Responsivity,
}

/// What a column is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Role {
    /// Ellipticity.
    E1,
    /// Ellipticity.
    E2,
    /// Weight.
    Weight,
    /// Response of e1 to g1.
    R11,
    /// Response of e2 to g2.
    R22,
    /// Response of e1 to g2.
    R12,
    /// Response of e2 to g1.
    R21,
    /// What e1 was divided by.
    Divisor1,
    /// What e2 was divided by.
    Divisor2,
    /// Derivative of the weight with g1.
    Dw1,
    /// Derivative of the weight with g2.
    Dw2,
    /// Standard deviation of each component of the distortions of galaxies without measurement noise.
    RmsE,
    /// Measurement noise of each component of a distortion.
    SigmaE,
    /// Shear of rows that have no distortion, in GalSim's tables of HSM.
    KsbE1,
    /// The same of component 2.
    KsbE2,
    /// Zero for good rows.
    Flag,
    /// True shear.
    G1,
    /// True shear.
    G2,
    /// Ellipticity of the PSF.
    Psf1,
    /// Ellipticity of the PSF.
    Psf2,
    /// Size of the PSF.
    PsfSize,
    /// Identifier of the galaxy.
    Id,
    /// Position in pixels.
    X,
    /// Position in pixels.
    Y,
    /// Independent unit.
    Unit,
    /// Name of the version: noshear, 1p, 1m, 2p, 2m.
    Version,
    /// e1 under an artificial shear of +g1.
    E1p,
    /// e1 under an artificial shear of −g1.
    E1m,
    /// e2 under an artificial shear of +g2.
    E2p,
    /// e2 under an artificial shear of −g2.
    E2m,
    /// e1 under an artificial shear of +g2.
    E1Of2p,
    /// e1 under an artificial shear of −g2.
    E1Of2m,
    /// e2 under an artificial shear of +g1.
    E2Of1p,
    /// e2 under an artificial shear of −g1.
    E2Of1m,
}

/// The roles with their names in `--columns`, and names of columns that are recognised in any case, the first first.
const ROLES: [(Role, &str, &[&str]); 34] = [
    (
        Role::E1,
        "e1",
        &[
            "e1",
            "e_1",
            "e1_noshear",
            "g1_noshear",
            "g[0]",
            "ngmix_ell_noshear[0]",
            "wmom_g_1",
            "wmom_g1",
            "gauss_g1",
            "pgauss_g1",
            "gauss_g_1",
            "pgauss_g_1",
            "mdet_g_1",
            "mcal_g_1",
            "fpfs_e1",
            "fpfs1_e1",
            "regauss_e1",
            "corrected_e1",
            "ext_shapehsm_hsmshaperegauss_e1",
            "corrected_g1",
        ],
    ),
    (
        Role::E2,
        "e2",
        &[
            "e2",
            "e_2",
            "e2_noshear",
            "g2_noshear",
            "g[1]",
            "ngmix_ell_noshear[1]",
            "wmom_g_2",
            "wmom_g2",
            "gauss_g2",
            "pgauss_g2",
            "gauss_g_2",
            "pgauss_g_2",
            "mdet_g_2",
            "mcal_g_2",
            "fpfs_e2",
            "fpfs1_e2",
            "regauss_e2",
            "corrected_e2",
            "ext_shapehsm_hsmshaperegauss_e2",
            "corrected_g2",
        ],
    ),
    (
        Role::Weight,
        "w",
        &[
            "w",
            "weight",
            "weights",
            "wt",
            "shear_weight",
            "wdet",
            "wsel",
            "fpfs_w",
        ],
    ),
    (
        Role::R11,
        "R11",
        &[
            "r11",
            "de1_dg1",
            "e1_g1",
            "fpfs_de1_dg1",
            "fpfs1_de1_dg1",
            "r_11",
            "mcal_r11",
        ],
    ),
    (
        Role::R22,
        "R22",
        &[
            "r22",
            "de2_dg2",
            "e2_g2",
            "fpfs_de2_dg2",
            "fpfs1_de2_dg2",
            "r_22",
            "mcal_r22",
        ],
    ),
    (
        Role::R12,
        "R12",
        &[
            "r12",
            "de1_dg2",
            "e1_g2",
            "fpfs_de1_dg2",
            "fpfs1_de1_dg2",
            "r_12",
            "mcal_r12",
        ],
    ),
    (
        Role::R21,
        "R21",
        &[
            "r21",
            "de2_dg1",
            "e2_g1",
            "fpfs_de2_dg1",
            "fpfs1_de2_dg1",
            "r_21",
            "mcal_r21",
        ],
    ),
    (
        Role::Dw1,
        "dw1",
        &[
            "dw_dg1",
            "w_g1",
            "dweight_dg1",
            "dwdet_dg1",
            "wdet_g1",
            "dwsel_dg1",
            "wsel_g1",
            "fpfs_dw_dg1",
            "weight_dg1",
        ],
    ),
    (
        Role::Dw2,
        "dw2",
        &[
            "dw_dg2",
            "w_g2",
            "dweight_dg2",
            "dwdet_dg2",
            "wdet_g2",
            "dwsel_dg2",
            "wsel_g2",
            "fpfs_dw_dg2",
            "weight_dg2",
        ],
    ),
    (Role::RmsE, "rms_e", &["rms_e"]),
    (Role::SigmaE, "sigma_e", &["sigma_e"]),
    (Role::KsbE1, "ksb_e1", &["corrected_g1"]),
    (Role::KsbE2, "ksb_e2", &["corrected_g2"]),
    (
        Role::Flag,
        "flag",
        &[
            "flag",
            "flags",
            "flags_select",
            "wmom_flags",
            "mdet_flags",
            "ext_shapehsm_hsmshaperegauss_flag",
            "error_flag",
        ],
    ),
    (
        Role::G1,
        "g1",
        &["g1", "g1_true", "true_g1", "g1_truth", "gamma1", "shear1"],
    ),
    (
        Role::G2,
        "g2",
        &["g2", "g2_true", "true_g2", "g2_truth", "gamma2", "shear2"],
    ),
    (
        Role::Psf1,
        "psf_e1",
        &[
            "psf_e1",
            "e1_psf",
            "psf_g1",
            "g1_psf",
            "psf_g_1",
            "psfrec_g_1",
        ],
    ),
    (
        Role::Psf2,
        "psf_e2",
        &[
            "psf_e2",
            "e2_psf",
            "psf_g2",
            "g2_psf",
            "psf_g_2",
            "psfrec_g_2",
        ],
    ),
    (
        Role::PsfSize,
        "psf_size",
        &[
            "psf_size",
            "psf_t",
            "t_psf",
            "psf_fwhm",
            "psf_sigma",
            "psfrec_t",
        ],
    ),
    (
        Role::Id,
        "id",
        &[
            "id",
            "galaxy_id",
            "gal_id",
            "object_id",
            "objectid",
            "coadd_object_id",
            "coadd_objects_id",
            "source_id",
            "number",
        ],
    ),
    (Role::Divisor1, "divisor1", &["divisor1"]),
    (Role::Divisor2, "divisor2", &["divisor2"]),
    (Role::X, "x", &["x", "x_image", "xwin_image", "x_pix"]),
    (Role::Y, "y", &["y", "y_image", "ywin_image", "y_pix"]),
    (Role::Unit, "unit", &["pair", "pair_id", "seed", "patch"]),
    (
        Role::Version,
        "version",
        &[
            "mdet_step",
            "metastep",
            "shear_type",
            "metacal_step",
            "shear",
        ],
    ),
    (Role::E1p, "e1_1p", &["e1_1p", "g1_1p", "ngmix_ell_1p[0]"]),
    (Role::E1m, "e1_1m", &["e1_1m", "g1_1m", "ngmix_ell_1m[0]"]),
    (Role::E2p, "e2_2p", &["e2_2p", "g2_2p", "ngmix_ell_2p[1]"]),
    (Role::E2m, "e2_2m", &["e2_2m", "g2_2m", "ngmix_ell_2m[1]"]),
    (
        Role::E1Of2p,
        "e1_2p",
        &["e1_2p", "g1_2p", "ngmix_ell_2p[0]"],
    ),
    (
        Role::E1Of2m,
        "e1_2m",
        &["e1_2m", "g1_2m", "ngmix_ell_2m[0]"],
    ),
    (
        Role::E2Of1p,
        "e2_1p",
        &["e2_1p", "g2_1p", "ngmix_ell_1p[1]"],
    ),
    (
        Role::E2Of1m,
        "e2_1m",
        &["e2_1m", "g2_1m", "ngmix_ell_1m[1]"],
    ),
];

/// Roles of the responses of a component to the other one. Without those to the own component they are of no use.
const OTHER_RESPONSES: [(Role, Role); 6] = [
    (Role::R12, Role::R11),
    (Role::R21, Role::R22),
    (Role::E1Of2p, Role::E1p),
    (Role::E1Of2m, Role::E1p),
    (Role::E2Of1p, Role::E2p),
    (Role::E2Of1m, Role::E2p),
];

/// Pairs of columns that need each other.
const PAIRS: [(Role, Role); 11] = [
    (Role::Divisor1, Role::Divisor2),
    (Role::E1, Role::E2),
    (Role::R11, Role::R22),
    (Role::Dw1, Role::Dw2),
    (Role::G1, Role::G2),
    (Role::E1p, Role::E1m),
    (Role::E2p, Role::E2m),
    (Role::R12, Role::R21),
    (Role::KsbE1, Role::KsbE2),
    (Role::E1Of2p, Role::E1Of2m),
    (Role::E2Of1p, Role::E2Of1m),
];

/// Ellipticities of sheared versions: of the own component, and of the other one.
pub(super) const SHEARED: [[Role; 4]; 2] = [
    [Role::E1p, Role::E1m, Role::E2p, Role::E2m],
    [Role::E1Of2p, Role::E1Of2m, Role::E2Of1p, Role::E2Of1m],
];

/// Names of ellipticities that are distortions.
const DISTORTIONS: [&str; 3] = [
    "regauss_e1",
    "corrected_e1",
    "ext_shapehsm_hsmshaperegauss_e1",
];

/// A public catalogue or a program's output, whose columns are known by its documentation.
struct Survey {
    name: &'static str,
    /// The columns by role, in any case. Those of e1 and e2 and those with a plus identify the catalogue; others may be
    /// absent. `none` for a role that has no column although a general name is there.
    columns: &'static str,
    /// Whether ellipticities are distortions.
    distortion: bool,
}

const fn survey(name: &'static str, columns: &'static str) -> Survey {
    Survey {
        name,
        columns,
        distortion: false,
    }
}

/// Regauss of HSC and LSST: distortions. Their columns of a calibration of the shear bias (`derived_shear_bias_m`, `_c1`,
/// `_c2`) have no role, because m and c are to be found before it.
const fn distortions(name: &'static str, columns: &'static str) -> Survey {
    Survey {
        name,
        columns,
        distortion: true,
    }
}

/// From the column lists in tests/data/columns. The first that fits is used.
const SURVEYS: [Survey; 22] = [
    survey(
        "KiDS, internal",
        "e1=autocal_e1_A e2=autocal_e2_A w=recal_weight_A psf_e1=PSF_e1 psf_e2=PSF_e2",
    ),
    survey(
        "KV450",
        "e1=bias_corrected_e1 e2=bias_corrected_e2 w=recal_weight psf_e1=PSF_e1 psf_e2=PSF_e2",
    ),
    survey(
        "KiDS",
        "e1=e1 e2=e2 +w=weight +model_SNratio psf_e1=PSF_e1 psf_e2=PSF_e2",
    ),
    distortions(
        "HSC Y1",
        "e1=ishape_hsm_regauss_e1 e2=ishape_hsm_regauss_e2 w=ishape_hsm_regauss_derived_shape_weight rms_e=ishape_hsm_regauss_derived_rms_e flag=ishape_hsm_regauss_flags",
    ),
    distortions(
        "HSC Y1",
        "e1=ishape_hsm_regauss_e1 e2=ishape_hsm_regauss_e2 w=ishape_hsm_regauss_derived_weight rms_e=ishape_hsm_regauss_derived_rms_e flag=ishape_hsm_regauss_flags",
    ),
    distortions(
        "HSC Y3",
        "e1=i_hsmshaperegauss_e1 e2=i_hsmshaperegauss_e2 +w=i_hsmshaperegauss_derived_weight rms_e=i_hsmshaperegauss_derived_rms_e flag=i_hsmshaperegauss_flag",
    ),
    distortions(
        "LSST",
        "e1=i_hsmShapeRegauss_e1 e2=i_hsmShapeRegauss_e2 flag=i_hsmShapeRegauss_flag",
    ),
    distortions(
        "LSST",
        "e1=r_hsmShapeRegauss_e1 e2=r_hsmShapeRegauss_e2 flag=r_hsmShapeRegauss_flag",
    ),
    distortions(
        "LSST",
        "e1=ext_shapeHSM_HsmShapeRegauss_e1 e2=ext_shapeHSM_HsmShapeRegauss_e2 flag=ext_shapeHSM_HsmShapeRegauss_flag",
    ),
    survey(
        "DES Y1",
        "e1=e1 e2=e2 +R11=R11 R22=R22 R12=R12 R21=R21 +flag=flags_select id=coadd_objects_id",
    ),
    survey(
        "DES Y3",
        "e1=e_1 e2=e_2 +R11=R11 R22=R22 R12=R12 R21=R21 w=weight flag=flags",
    ),
    survey(
        "DES Y6",
        "e1=gauss_g_1 e2=gauss_g_2 +version=mdet_step w=w flag=mdet_flags",
    ),
    survey(
        "metadetect",
        "e1=wmom_g_1 e2=wmom_g_2 +version=shear flag=wmom_flags psf_e1=psfrec_g_1 psf_e2=psfrec_g_2",
    ),
    // Already divided by the mean response.
    survey(
        "UNIONS",
        "e1=e1 e2=e2 +w=w_des R11=none R22=none psf_e1=e1_PSF psf_e2=e2_PSF",
    ),
    survey(
        "UNIONS",
        "e1=e1 e2=e2 +w=w_iv R11=none R22=none psf_e1=e1_PSF psf_e2=e2_PSF",
    ),
    survey(
        "UNIONS, uncalibrated",
        "e1=e1_uncal e2=e2_uncal R11=R_g11 R12=R_g12 R21=R_g21 R22=R_g22 w=w_des psf_e1=e1_PSF psf_e2=e2_PSF",
    ),
    survey(
        "ShapePipe",
        "e1=NGMIX_G1_NOSHEAR e2=NGMIX_G2_NOSHEAR flag=NGMIX_MCAL_FLAGS e1_1p=NGMIX_G1_1P e1_1m=NGMIX_G1_1M e2_2p=NGMIX_G2_2P e2_2m=NGMIX_G2_2M e1_2p=NGMIX_G1_2P e1_2m=NGMIX_G1_2M e2_1p=NGMIX_G2_1P e2_1m=NGMIX_G2_1M",
    ),
    survey(
        "Euclid, LensMC",
        "e1=SHE_LENSMC_E1 e2=SHE_LENSMC_E2 w=SHE_LENSMC_WEIGHT",
    ),
    survey(
        "TXPipe",
        "e1=mcal_g1 e2=mcal_g2 flag=mcal_flags psf_e1=mcal_psf_g1 psf_e2=mcal_psf_g2 e1_1p=mcal_g1_1p e1_1m=mcal_g1_1m e2_2p=mcal_g2_2p e2_2m=mcal_g2_2m e1_2p=mcal_g1_2p e1_2m=mcal_g1_2m e2_1p=mcal_g2_1p e2_1m=mcal_g2_1m",
    ),
    // Of a model by default. Those of FPFS have their own responses. The weight of the selection contains that of the
    // detection.
    survey(
        "AnaCal task",
        "e1=e1 e2=e2 +fpfs_e1 +R11=de1_dg1 R12=de1_dg2 R21=de2_dg1 R22=de2_dg2 +w=wsel dw1=dwsel_dg1 dw2=dwsel_dg2",
    ),
    survey(
        "AnaCal task",
        "e1=e1 e2=e2 +fpfs_e1 +R11=de1_dg1 R12=de1_dg2 R21=de2_dg1 R22=de2_dg2 w=wdet dw1=dwdet_dg1 dw2=dwdet_dg2",
    ),
    survey(
        "AnaCal FPFS",
        "e1=fpfs_e1 e2=fpfs_e2 R11=fpfs_de1_dg1 R12=fpfs_de1_dg2 R21=fpfs_de2_dg1 R22=fpfs_de2_dg2 +w=wsel dw1=dwsel_dg1 dw2=dwsel_dg2",
    ),
];

impl Survey {
    /// Each column with its role, and whether the catalogue must have it.
    fn parts(&self) -> impl Iterator<Item = (Option<&'static str>, &'static str, bool)> {
        self.columns.split(' ').map(|part| {
            let required = part.strip_prefix('+');
            let (role, column) = match required.unwrap_or(part).split_once('=') {
                Some((role, column)) => (Some(role), column),
                None => (None, required.unwrap_or(part)),
            };
            let shape = matches!(role, Some("e1" | "e2"));
            (role, column, required.is_some() || shape)
        })
    }

    /// The column of a role.
    fn of(&self, key: &str) -> Option<&'static str> {
        let mut parts = self.parts();
        parts.find_map(|(role, column, _)| (role == Some(key)).then_some(column))
    }

    /// Whether the catalogue with the columns `found` is this one. Given names of e1 and e2 must be those of this one.
    fn fits(&self, found: &[String], names: &Names) -> bool {
        let there = |column: &str| found.iter().any(|own| own.eq_ignore_ascii_case(column));
        self.parts().all(|(role, column, required)| {
            let given = role.and_then(|role| names.0.get(role));
            match given {
                Some(given) if matches!(role, Some("e1" | "e2")) => {
                    given.eq_ignore_ascii_case(column)
                }
                Some(_) => true,
                None => !required || there(column),
            }
        })
    }
}

/// Adds sheared versions by the names of e1 and e2: `foo_g1_1p` belongs to `foo_g1` or `foo_g1_noshear`.
fn find_sheared(roles: &mut BTreeMap<Role, String>, found: &[String], names: &Names) {
    let of = |shape: Role, sheared: [Role; 4], suffixes: [&str; 4]| {
        let name = roles.get(&shape)?.to_ascii_lowercase();
        let base = name.strip_suffix("_noshear").unwrap_or(&name).to_owned();
        let mut all = Vec::new();
        for (role, suffix) in sheared.into_iter().zip(suffixes) {
            let wanted = format!("{base}_{suffix}");
            let column = found.iter().find(|own| own.eq_ignore_ascii_case(&wanted))?;
            all.push((role, column.clone()));
        }
        Some(all)
    };
    let [[p1, m1, p2, m2], [p12, m12, p21, m21]] = SHEARED;
    let suffixes = ["1p", "1m", "2p", "2m"];
    let all = [
        of(Role::E1, [p1, m1, p12, m12], suffixes),
        of(Role::E2, [p21, m21, p2, m2], suffixes),
    ];
    for (role, column) in all.into_iter().flatten().flatten() {
        if !names.0.contains_key(key_of(role)) {
            roles.entry(role).or_insert(column);
        }
    }
}

/// Columns that say which rows count, and whether those of value 1 do. Rows of the overlap of tiles are there twice; of
/// blends that were not separated, and of stars, the shapes are not those of a galaxy.
const CHOICES: [(&str, bool); 7] = [
    ("is_primary", true),
    ("is_inner", true),
    ("primary", true),
    ("inner", true),
    ("detect_isprimary", true),
    ("deblend_failed", false),
    ("refextendedness", true),
];

/// Columns of flags. A row counts if all are zero: DES has the failures in `flags` and the cuts in `flags_select`, and
/// metadetection one flag per kind of shape.
fn find_flags(
    path: &Path,
    found: &[String],
    names: &Names,
    survey: Option<&Survey>,
    e1: Option<&String>,
) -> Result<Vec<String>, FileError> {
    match names.0.get("flag") {
        None => {}
        Some(none) if none == "none" => return Ok(Vec::new()),
        Some(given) if found.contains(given) => return Ok(vec![given.clone()]),
        Some(given) => {
            let flags = given.split('+').map(str::to_owned);
            let known = |name: String| match found.contains(&name) {
                true => Ok(name),
                false => Err(FileError::no_column(path, &name, found)),
            };
            return flags.map(known).collect();
        }
    }
    let own = |name: &str| {
        let mut found = found.iter();
        found.find(|own| own.eq_ignore_ascii_case(name) && names.role_of(own).is_none())
    };
    let mut flags: Vec<String> = Vec::new();
    let first = match survey.and_then(|survey| survey.of("flag")) {
        Some(known) => own(known),
        None => names_of_role(Role::Flag).iter().find_map(|name| own(name)),
    };
    let e1 = e1.map_or_else(String::new, |e1| e1.to_ascii_lowercase());
    let e1 = e1.strip_suffix("_noshear").unwrap_or(&e1);
    let mut endings = ["_g_1", "_g1", "_g[0]", "_e_1", "_e1", "_e[0]"].into_iter();
    let kind = endings.find_map(|ending| e1.strip_suffix(ending));
    let of_kind = |ending: &str| own(&format!("{}_{ending}", kind?));
    let by_cuts = own("flags_select");
    let failures = own("flags").filter(|_| by_cuts.is_some());
    let of_ngmix = own("ngmix_mcal_flags").filter(|_| e1.starts_with("ngmix"));
    let of_kind = [of_kind("flags"), of_kind("flag"), of_ngmix];
    let all = [first, failures, by_cuts].into_iter().chain(of_kind);
    for name in all.flatten() {
        if !flags.contains(name) {
            flags.push(name.clone());
        }
    }
    Ok(flags)
}

/// What the name of a column suggests that it is.
fn suggested(name: &str) -> Option<&'static str> {
    let name = name.to_ascii_lowercase();
    if CHOICES.iter().any(|(known, _)| *known == name) {
        return Some("a choice");
    }
    let has = |parts: &[&str]| parts.iter().any(|part| name.contains(part));
    let ends = |parts: &[&str]| parts.iter().any(|part| name.ends_with(part));
    if ends(&["_dg1", "_dg2"]) {
        return Some("a derivative");
    }
    if ends(&["_1p", "_1m", "_2p", "_2m"]) {
        return Some("a sheared version");
    }
    if has(&["shear_bias"]) {
        return Some("a calibration");
    }
    if is_weight(&name) {
        return Some("a weight");
    }
    if has(&["flag", "mask"]) {
        return Some("a flag");
    }
    let response = ["r11", "r12", "r21", "r22", "r_11", "r_12", "r_21", "r_22"];
    if response.contains(&name.as_str())
        || ends(&[
            "_g11", "_g12", "_g21", "_g22", "_r11", "_r12", "_r21", "_r22",
        ])
        || has(&["response"])
    {
        return Some("a response");
    }
    if has(&["rms_e", "sigma_e", "regauss_sigma", "shape_err"]) {
        return Some("noise of shapes");
    }
    None
}

/// Whether a name in small letters is that of a weight.
fn is_weight(name: &str) -> bool {
    let name = name.strip_suffix("_a").unwrap_or(name);
    name == "w" || name == "wt" || name.starts_with("w_") || name.ends_with("weight")
}

/// Names for roles that were given: a column, or `none`.
#[derive(Debug, Clone, Default)]
pub struct Names(BTreeMap<&'static str, String>);

/// The names of all roles.
pub fn role_names() -> String {
    ROLES.map(|(_, name, _)| name).join(", ")
}

impl Names {
    /// Adds `ROLE=COLUMN`.
    ///
    /// # Errors
    /// If there is no such role.
    pub fn add(&mut self, text: &str) -> Result<(), String> {
        let known = role_names;
        let given = text
            .split_once('=')
            .filter(|(_, column)| !column.is_empty());
        let Some((role, column)) = given else {
            return Err(format!(
                "--columns: found `{text}`, expected ROLE=COLUMN with a role of {}",
                known()
            ));
        };
        let Some((_, name, _)) = ROLES.iter().find(|(_, name, _)| *name == role) else {
            return Err(format!(
                "--columns: unknown role (found `{role}`, expected one of {})",
                known()
            ));
        };
        if self.0.insert(name, column.to_owned()).is_some() {
            return Err(format!("--columns: {role} is given twice"));
        }
        Ok(())
    }

    /// Whether the responses of each component to the other one are not to be used, in columns or by sheared versions.
    pub fn decline_matrix(&self) -> bool {
        ["R12", "R21"]
            .iter()
            .any(|role| self.0.get(role).is_some_and(|own| own == "none"))
    }

    /// The role for which a column is given.
    pub fn role_of(&self, column: &str) -> Option<&'static str> {
        let mut given = self.0.iter();
        given.find_map(|(role, own)| (own == column && own != "none").then_some(*role))
    }

    /// Whether a role has a column by option.
    pub fn is_given(&self, role: &str) -> bool {
        self.0.contains_key(role)
    }

    /// Refuses a column with two roles: measured shears that are also the true ones have m = 0.
    fn check_single_roles(&self, path: &Path) -> Result<(), FileError> {
        for (role, column) in &self.0 {
            let first = self.role_of(column).unwrap_or(role);
            if first != *role && !SHARED.contains(&[first, role]) {
                return Err(FileError::new(
                    path,
                    format!(
                        "column `{column}` is given as {first} and as {role} (expected one role). Try: --columns {role}=NAME, or {role}=none"
                    ),
                ));
            }
        }
        Ok(())
    }

    /// Refuses columns with names of true shears that are given as something else, if nothing else states the true shear.
    ///
    /// # Errors
    /// If there are such columns and `--columns` contains no g1.
    pub fn check_true_shear(&self, path: &Path) -> Result<(), FileError> {
        if self.0.contains_key("g1") || self.0.contains_key("g2") {
            return Ok(());
        }
        let names = ROLES
            .iter()
            .filter(|(role, _, _)| matches!(role, Role::G1 | Role::G2));
        let mut names = names.flat_map(|(_, _, names)| names.iter().copied());
        let taken = |name: &&str| {
            let mut given = self.0.values();
            given.any(|own| own.eq_ignore_ascii_case(name))
        };
        match names.find(taken) {
            None => Ok(()),
            Some(name) => Err(FileError::new(
                path,
                format!(
                    "`{name}` is given as {}, so the true shear is unknown. Try: --truth FILE, --columns g1=NAME,g2=NAME, or g1=none,g2=none for c alone",
                    self.role_of(name).unwrap_or("another role")
                ),
            )),
        }
    }
}

/// Roles that one column may have together: a scalar response of both components, and identifiers of units.
const SHARED: [[&str; 2]; 3] = [["R11", "R22"], ["divisor1", "divisor2"], ["id", "unit"]];

/// Which program wrote a catalogue, recognised by its columns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Preset {
    /// No known program.
    Plain,
    /// shearq: ellipticities are already divided by the divisors.
    Shearq,
    /// shearq with sheared versions of all columns.
    Versions,
    /// GalSim's or LSST's HSM.
    Hsm,
    /// Metacalibration with columns per version.
    Metacal,
    /// Metadetection: rows per version.
    Metadetect,
    /// AnaCal, with derivatives.
    Anacal,
}

impl Preset {
    fn of_roles(roles: &BTreeMap<Role, String>, is_hsm: bool) -> Self {
        if roles.contains_key(&Role::Version) {
            Preset::Metadetect
        } else if roles.contains_key(&Role::Divisor1) && roles.contains_key(&Role::R11) {
            Preset::Shearq
        } else if roles.contains_key(&Role::E1p) && roles.contains_key(&Role::E2p) {
            Preset::Metacal
        } else if is_hsm {
            Preset::Hsm
        } else if roles.contains_key(&Role::Dw1) {
            Preset::Anacal
        } else {
            Preset::Plain
        }
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Preset::Plain => "plain columns",
            Preset::Shearq => "shearq",
            Preset::Versions => "shearq, sheared versions",
            Preset::Hsm => "HSM",
            Preset::Metacal => "ngmix metacal",
            Preset::Metadetect => "metadetect",
            Preset::Anacal => "AnaCal",
        }
    }
}

/// The columns of a catalogue by role.
#[derive(Debug, Clone)]
pub struct Columns {
    roles: BTreeMap<Role, String>,
    /// The program.
    pub preset: Preset,
    /// The public catalogue or the output of a program that its columns are known from.
    survey: Option<&'static str>,
    /// Whether the names say that ellipticities are distortions.
    pub distortion: bool,
    /// A column that looks like a weight, if none has this role and it was not declined.
    pub doubtful_weight: Option<String>,
    /// Columns that look like a weight, flag, response, derivative or sheared version and have no role.
    unused: Vec<String>,
    /// All columns of flags; the first is that of the role.
    pub flags: Vec<String>,
    /// Columns of [`CHOICES`], with whether rows of value 1 count.
    pub choices: Vec<(String, bool)>,
    /// Columns that may hold names of versions, if no column has this role and it was not declined.
    pub steps: Vec<String>,
}

impl Columns {
    /// Finds the columns of the catalogue `path`, which has the columns `found`.
    ///
    /// # Errors
    /// If a given column is absent or has two roles, e1 or e2 cannot be found, or one of two columns that belong together
    /// is absent.
    pub fn find(path: &Path, found: &[String], names: &Names) -> Result<Self, FileError> {
        names.check_single_roles(path)?;
        let mut roles = BTreeMap::new();
        let survey = SURVEYS.iter().find(|survey| survey.fits(found, names));
        for (role, key, candidates) in ROLES {
            if role == Role::Flag {
                continue;
            }
            let by_survey = survey.and_then(|survey| survey.of(key));
            // A column called g1 that is given as e1 is not the true shear, too.
            let own = |name: &str| {
                let vector = in_vector(name);
                let is_named = |own: &&String| {
                    own.eq_ignore_ascii_case(name)
                        || vector
                            .as_ref()
                            .is_some_and(|name| own.eq_ignore_ascii_case(name))
                };
                found
                    .iter()
                    .filter(is_named)
                    .find(|own| names.role_of(own).is_none())
            };
            let column = match (names.0.get(key), by_survey) {
                (Some(none), _) if none == "none" => None,
                (Some(given), _) if found.contains(given) => Some(given),
                (Some(given), _) => return Err(FileError::no_column(path, given, found)),
                (None, Some(known)) => own(known),
                (None, None) => candidates.iter().find_map(|name| own(name)),
            };
            if let Some(column) = column {
                roles.insert(role, column.clone());
            }
        }
        let shape = roles.get(&Role::E1).map(|e1| e1.to_ascii_lowercase());
        if shape.is_none_or(|e1| e1 != "corrected_e1") {
            for role in [Role::KsbE1, Role::KsbE2] {
                roles.remove(&role);
            }
        }
        let flags = find_flags(path, found, names, survey, roles.get(&Role::E1))?;
        roles.extend(flags.first().map(|first| (Role::Flag, first.clone())));
        find_sheared(&mut roles, found, names);
        let diagonal = names.decline_matrix();
        for (other, own) in OTHER_RESPONSES {
            if diagonal || !roles.contains_key(&own) {
                roles.remove(&other);
            }
        }
        if !roles.contains_key(&Role::E1) && !roles.contains_key(&Role::E2) {
            return Err(FileError::new(
                path,
                format!(
                    "there are no columns of ellipticities (found {}, expected e1 and e2). Try: --columns e1=NAME,e2=NAME",
                    names_of(found)
                ),
            ));
        }
        for (a, b) in PAIRS {
            for (there, absent) in [(a, b), (b, a)] {
                if let (Some(column), false) = (roles.get(&there), roles.contains_key(&absent)) {
                    let key = key_of(absent);
                    return Err(FileError::new(
                        path,
                        format!(
                            "there is a column `{column}` but none for {key} (found {}). Try: --columns {key}=NAME, or {}=none",
                            names_of(found),
                            key_of(there)
                        ),
                    ));
                }
            }
        }
        let e1 = roles[&Role::E1].to_ascii_lowercase();
        let distortion =
            DISTORTIONS.contains(&e1.as_str()) || survey.is_some_and(|survey| survey.distortion);
        let preset = Preset::of_roles(&roles, distortion || e1 == "corrected_g1");
        let mut columns = Columns {
            roles,
            preset,
            survey: survey.map(|survey| survey.name),
            distortion,
            doubtful_weight: None,
            unused: Vec::new(),
            flags,
            choices: Vec::new(),
            steps: Vec::new(),
        };
        if preset == Preset::Metacal && !names.0.contains_key("e1") {
            columns.take_unsheared(found);
        }
        columns.find_unused(found, names);
        Ok(columns)
    }

    /// Notes columns without a role whose names suggest one. All columns of shearq are known.
    fn find_unused(&mut self, found: &[String], names: &Names) {
        if self.preset == Preset::Shearq {
            return;
        }
        let taken = self.roles.values().chain(&self.flags).cloned();
        let taken: Vec<String> = taken.collect();
        let unused = || found.iter().filter(|name| !taken.contains(name));
        let choice = |name: &String| {
            let mut known = CHOICES.iter();
            let known = known.find(|(known, _)| known.eq_ignore_ascii_case(name))?;
            Some((name.clone(), known.1))
        };
        self.choices = unused().filter_map(choice).collect();
        if self.of(Role::Version).is_none() && !names.0.contains_key("version") {
            let is_step = |name: &&String| {
                let name = name.to_ascii_lowercase();
                name.contains("step") || name.contains("shear_type") || name == "shear"
            };
            self.steps = unused().filter(is_step).cloned().collect();
        }
        if self.of(Role::Weight).is_none() && !names.0.contains_key("w") {
            let mut weights = unused().filter(|name| suggested(name) == Some("a weight"));
            self.doubtful_weight = weights.next().cloned();
        }
        self.unused = unused()
            .filter(|name| suggested(name).is_some())
            .cloned()
            .collect();
    }

    /// The public catalogue or the program that wrote it.
    pub fn program(&self) -> &'static str {
        self.survey.unwrap_or(self.preset.name())
    }

    /// Each column that is used, as in `--columns`. Roles that are not `read` are left out.
    pub fn used(&self, read: impl Fn(Role) -> bool) -> String {
        let named = ROLES.iter().filter_map(|(role, key, _)| {
            let column = self.of(*role).filter(|_| read(*role))?;
            Some(match role {
                Role::Flag => format!("{key}={}", self.flags.join("+")),
                _ => format!("{key}={column}"),
            })
        });
        named.collect::<Vec<_>>().join(", ")
    }

    /// Columns that look like one of a role but have none, unless they are `read` for another reason.
    pub fn unused(&self, read: &[String]) -> Option<String> {
        let unused = self.unused.iter().filter(|name| !read.contains(name));
        let unused: Vec<&String> = unused.collect();
        let calibrates = |name: &&&String| suggested(name) == Some("a calibration");
        let calibration = match unused.iter().find(calibrates) {
            Some(name) => format!(" m and c are those before the calibration by `{name}`."),
            None => String::new(),
        };
        (!unused.is_empty()).then(|| {
            format!(
                "Not used: {}. Try: --columns ROLE=NAME if the result needs one.{calibration}",
                names_of(&unused)
            )
        })
    }

    /// Of a catalogue of shearq with sheared versions, takes these versions if a selection requires them, and otherwise the
    /// columns without them, which have less noise.
    pub fn choose_versions(&mut self, found: &[String], required: bool) {
        if self.preset != Preset::Shearq || !self.roles.contains_key(&Role::E1p) {
            return;
        }
        if required {
            self.preset = Preset::Versions;
            self.take_unsheared(found);
        } else {
            for role in SHEARED.into_iter().flatten() {
                self.roles.remove(&role);
            }
        }
    }

    /// Takes the ellipticity of the unsheared version if there is one: other columns may have less noise than versions.
    fn take_unsheared(&mut self, found: &[String]) {
        for (role, name) in [(Role::E1, "e1_noshear"), (Role::E2, "e2_noshear")] {
            if found.iter().any(|own| own == name) {
                self.roles.insert(role, name.to_owned());
            }
        }
    }

    /// The column of a role.
    pub fn of(&self, role: Role) -> Option<&str> {
        self.roles.get(&role).map(String::as_str)
    }

    /// Whether all of some roles have columns.
    pub fn have(&self, roles: &[Role]) -> bool {
        roles.iter().all(|role| self.roles.contains_key(role))
    }

    /// All columns.
    pub fn all(&self) -> impl Iterator<Item = (Role, &str)> {
        self.roles.iter().map(|(role, name)| (*role, name.as_str()))
    }
}

/// Names of columns of a role, in any case.
pub(super) fn names_of_role(role: Role) -> &'static [&'static str] {
    let found = ROLES.iter().find(|(other, _, _)| *other == role);
    found.map_or(&[], |(_, _, names)| names)
}

/// The name of a component of a vector, `g[0]` for `g_1`.
fn in_vector(name: &str) -> Option<String> {
    let first = name.strip_suffix("_1").map(|vector| format!("{vector}[0]"));
    first.or_else(|| name.strip_suffix("_2").map(|vector| format!("{vector}[1]")))
}

/// Name of a role in `--columns`.
fn key_of(role: Role) -> &'static str {
    let found = ROLES.iter().find(|(other, _, _)| *other == role);
    found.map_or("", |(_, key, _)| key)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(columns: &str, given: &[&str]) -> Result<Columns, String> {
        let columns: Vec<String> = columns.split(' ').map(str::to_owned).collect();
        let mut names = Names::default();
        for text in given {
            names.add(text)?;
        }
        Columns::find(Path::new("c.fits"), &columns, &names).map_err(|error| error.to_string())
    }

    #[test]
    fn programs_are_recognised_by_their_columns() {
        for (columns, preset) in [
            ("e1 e2 w flag", Preset::Plain),
            ("x y e1 e2 flags R11 R22 divisor1 divisor2", Preset::Shearq),
            (
                "e1 e2 flags R11 R22 divisor1 divisor2 e1_noshear e2_noshear e1_1p e1_1m e2_2p e2_2m",
                Preset::Shearq,
            ),
            ("corrected_e1 corrected_e2", Preset::Hsm),
            (
                "e1_noshear e2_noshear e1_1p e1_1m e2_2p e2_2m",
                Preset::Metacal,
            ),
            ("wmom_g_1 wmom_g_2 w mdet_step", Preset::Metadetect),
            ("e1 de1_dg1 e2 de2_dg2 w dw_dg1 dw_dg2", Preset::Anacal),
        ] {
            assert_eq!(found(columns, &[]).unwrap().preset, preset, "{columns}");
        }
        assert!(found("corrected_e1 corrected_e2", &[]).unwrap().distortion);
        let names =
            "e1 e2 flags R11 R22 divisor1 divisor2 e1_noshear e2_noshear e1_1p e1_1m e2_2p e2_2m";
        for (required, preset, e1, plus) in [
            (true, Preset::Versions, "e1_noshear", Some("e1_1p")),
            (false, Preset::Shearq, "e1", None),
        ] {
            let mut own = found(names, &[]).unwrap();
            let all: Vec<String> = names.split(' ').map(str::to_owned).collect();
            own.choose_versions(&all, required);
            assert_eq!((own.preset, own.of(Role::E1)), (preset, Some(e1)));
            assert_eq!(own.of(Role::E1p), plus);
        }
        let given = found("a b R11 R22", &["e1=a", "e2=b", "R11=none", "R22=none"]).unwrap();
        assert_eq!((given.of(Role::E1), given.of(Role::R11)), (Some("a"), None));
    }

    #[test]
    fn a_column_has_one_role() {
        let own = found("g1 g2", &["e1=g1", "e2=g2"]).unwrap();
        assert_eq!((own.of(Role::E1), own.of(Role::G1)), (Some("g1"), None));
        let own = found(
            "g1 g2 g1_true g2_true",
            &["e1=g1", "e2=g2", "g1=g1_true", "g2=g2_true"],
        );
        assert_eq!(own.unwrap().of(Role::G1), Some("g1_true"));
        let own = found("wmom_g[0] wmom_g[1] mdet_step", &[]).unwrap();
        assert_eq!(own.of(Role::E2), Some("wmom_g[1]"));
        let own = found("e1 e2 R", &["R11=R", "R22=R"]).unwrap();
        assert_eq!(
            (own.of(Role::R11), own.of(Role::R22)),
            (Some("R"), Some("R"))
        );
    }

    #[test]
    fn columns_that_are_absent_are_named() {
        for (columns, given, expected) in [
            ("a b", vec![], "expected e1 and e2). Try: --columns"),
            ("e1 e2 R11", vec![], "none for R22"),
            ("e1 e2", vec!["w=weight"], "there is no column `weight`"),
            ("e1 e2", vec!["q=weight"], "unknown role (found `q`"),
            ("e1 e2", vec!["w"], "expected ROLE=COLUMN"),
            (
                "g1 g2",
                vec!["e1=g1", "e2=g2", "g1=g1", "g2=g2"],
                "column `g1` is given as e1 and as g1",
            ),
        ] {
            let error = found(columns, &given).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
    }
    /// Column lists of public catalogues as their documentation has them, a name per line, with the columns that must be used.
    #[test]
    fn public_catalogues_are_read_by_their_published_columns() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/columns");
        let mut count = 0;
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let text = std::fs::read_to_string(&path).unwrap();
            let expected = text.lines().find_map(|line| line.strip_prefix("# used: "));
            let given = text.lines().find_map(|line| line.strip_prefix("# given: "));
            let names: Vec<&str> = text
                .lines()
                .filter(|line| !line.starts_with('#'))
                .flat_map(str::split_whitespace)
                .collect();
            let given: Vec<&str> = given.into_iter().flat_map(|text| text.split(' ')).collect();
            let columns = found(&names.join(" "), &given).unwrap();
            let used = columns.used(|_| true);
            let found = format!("Columns ({}): {used}.", columns.program());
            assert_eq!(found, expected.unwrap(), "{}", path.display());
            count += 1;
        }
        // The catalogues of the documentation.
        assert!(count >= 17, "{count}");
    }

    #[test]
    fn columns_that_look_like_a_role_are_named() {
        let columns = found("e1 e2 my_weight BadFlag T_1p T R12 mag", &["R11=none"]).unwrap();
        let unused = columns.unused(&[]).unwrap();
        assert!(unused.contains("my_weight, BadFlag, T_1p, R12"), "{unused}");
        let read = ["T_1p".to_owned()];
        assert!(!columns.unused(&read).unwrap().contains("T_1p"));
        assert_eq!(columns.doubtful_weight.as_deref(), Some("my_weight"));
        let declined = found("e1 e2 my_weight", &["w=none"]).unwrap();
        assert_eq!(declined.doubtful_weight, None);
        assert!(found("e1 e2 w mag T", &[]).unwrap().unused(&[]).is_none());
    }
}
