//! Which columns of a catalogue are what.

use std::collections::BTreeMap;
use std::path::Path;

use shearq_files::{FileError, names_of};

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
    /// What e1 was divided by.
    Divisor1,
    /// What e2 was divided by.
    Divisor2,
    /// Derivative of the weight with g1.
    Dw1,
    /// Derivative of the weight with g2.
    Dw2,
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
}

/// The roles with their names in `--columns`, and names of columns that are recognised in any case, the first first.
const ROLES: [(Role, &str, &[&str]); 24] = [
    (
        Role::E1,
        "e1",
        &[
            "e1",
            "e_1",
            "e1_noshear",
            "g1_noshear",
            "wmom_g_1",
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
            "wmom_g_2",
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
        ],
    ),
    (
        Role::Flag,
        "flag",
        &[
            "flag",
            "flags",
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
        &["mdet_step", "shear_type", "metacal_step"],
    ),
    (Role::E1p, "e1_1p", &["e1_1p", "g1_1p"]),
    (Role::E1m, "e1_1m", &["e1_1m", "g1_1m"]),
    (Role::E2p, "e2_2p", &["e2_2p", "g2_2p"]),
    (Role::E2m, "e2_2m", &["e2_2m", "g2_2m"]),
];

/// Pairs of columns that need each other.
const PAIRS: [(Role, Role); 7] = [
    (Role::Divisor1, Role::Divisor2),
    (Role::E1, Role::E2),
    (Role::R11, Role::R22),
    (Role::Dw1, Role::Dw2),
    (Role::G1, Role::G2),
    (Role::E1p, Role::E1m),
    (Role::E2p, Role::E2m),
];

/// Names of ellipticities that are distortions.
const DISTORTIONS: [&str; 3] = [
    "regauss_e1",
    "corrected_e1",
    "ext_shapehsm_hsmshaperegauss_e1",
];

/// Names for roles that were given: a column, or `none`.
#[derive(Debug, Clone, Default)]
pub struct Names(BTreeMap<&'static str, String>);

impl Names {
    /// Adds `ROLE=COLUMN`.
    ///
    /// # Errors
    /// If there is no such role.
    pub fn add(&mut self, text: &str) -> Result<(), String> {
        let known = || ROLES.map(|(_, name, _)| name).join(", ");
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
}

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
    /// Whether the names say that ellipticities are distortions.
    pub distortion: bool,
}

impl Columns {
    /// Finds the columns of the catalogue `path`, which has the columns `found`.
    ///
    /// # Errors
    /// If a given column is absent, e1 or e2 cannot be found, or one of two columns that belong together is absent.
    pub fn find(path: &Path, found: &[String], names: &Names) -> Result<Self, FileError> {
        let mut roles = BTreeMap::new();
        for (role, key, candidates) in ROLES {
            let column = match names.0.get(key) {
                Some(none) if none == "none" => None,
                Some(given) if found.contains(given) => Some(given),
                Some(given) => return Err(FileError::no_column(path, given, found)),
                None => candidates
                    .iter()
                    .find_map(|name| found.iter().find(|own| own.eq_ignore_ascii_case(name))),
            };
            if let Some(column) = column {
                roles.insert(role, column.clone());
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
        let distortion = DISTORTIONS.contains(&e1.as_str());
        let preset = if roles.contains_key(&Role::Version) {
            Preset::Metadetect
        } else if roles.contains_key(&Role::Divisor1) && roles.contains_key(&Role::R11) {
            Preset::Shearq
        } else if roles.contains_key(&Role::E1p) && roles.contains_key(&Role::E2p) {
            Preset::Metacal
        } else if distortion || e1 == "corrected_g1" {
            Preset::Hsm
        } else if roles.contains_key(&Role::Dw1) {
            Preset::Anacal
        } else {
            Preset::Plain
        };
        let mut columns = Columns {
            roles,
            preset,
            distortion,
        };
        if preset == Preset::Metacal && !names.0.contains_key("e1") {
            columns.take_unsheared(found);
        }
        Ok(columns)
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
            for role in [Role::E1p, Role::E1m, Role::E2p, Role::E2m] {
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
    fn columns_that_are_absent_are_named() {
        for (columns, given, expected) in [
            ("a b", vec![], "expected e1 and e2). Try: --columns"),
            ("e1 e2 R11", vec![], "none for R22"),
            ("e1 e2", vec!["w=weight"], "there is no column `weight`"),
            ("e1 e2", vec!["q=weight"], "unknown role (found `q`"),
            ("e1 e2", vec!["w"], "expected ROLE=COLUMN"),
        ] {
            let error = found(columns, &given).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
    }
}
