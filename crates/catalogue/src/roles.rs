//! Roles of columns, which `--columns` names, in the catalogue without artificial shear and in sheared ones.

use shearq_bias::SHEARED_CATALOGUES;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Role {
    E1,
    E2,
    Weight,
    R11,
    R22,
    R12,
    R21,
    Dw1,
    Dw2,
    /// Standard deviation of each component of the distortions of galaxies without measurement noise.
    RmsE,
    /// Measurement noise of each component of a distortion.
    SigmaE,
    /// Shears of rows that have no distortion, in GalSim's tables of HSM.
    KsbE1,
    KsbE2,
    /// Zero for good rows.
    Flag,
    G1,
    G2,
    Psf1,
    Psf2,
    PsfSize,
    Id,
    /// Position in pixels.
    X,
    Y,
    Unit,
    /// Name of the sheared catalogue of a row: noshear, 1p, 1m, 2p, 2m.
    ShearedCatalogue,
    /// Published calibrations of the shear: ⟨g⟩ = (⟨e⟩/R − ⟨c⟩)/(1 + ⟨m⟩).
    M,
    C1,
    C2,
    // The roles below follow from options and from other columns, and have no name in --columns.
    /// Operands of `--where`, and of `--bins`.
    Condition,
    Binned,
    /// Columns of cuts that no condition names.
    Choice,
    /// Flags of failed measurements of sheared catalogues.
    ShearedFailure,
    /// Looks like a weight, and is not used.
    DoubtfulWeight,
}

/// A role in one catalogue: 0 is the one without artificial shear, k the k-th of [`SHEARED_CATALOGUES`].
pub type Key = (Role, usize);

/// Catalogues: the one without artificial shear and [`SHEARED_CATALOGUES`].
pub const CATALOGUES: usize = 1 + SHEARED_CATALOGUES.len();
pub const ROLES: usize = Role::DoubtfulWeight as usize + 1;

/// The responses R11, R12, R21 and R22: of e1 and e2 by rows, to g1 and g2.
pub const RESPONSES: [[Role; 2]; 2] = [[Role::R11, Role::R12], [Role::R21, Role::R22]];

/// The ellipticity component `of` in the catalogues with a positive and a negative artificial shear of the component
/// `sheared`, whose difference is a response.
pub fn sheared_pair(of: usize, sheared: usize) -> [Key; 2] {
    let role = [Role::E1, Role::E2][of];
    [(role, 1 + 2 * sheared), (role, 2 + 2 * sheared)]
}

// In the order of `Role`s: the role, its name in --columns, and the role without which it is incomplete.
const TABLE: [(Role, &str, Option<Role>); 27] = [
    (Role::E1, "e1", Some(Role::E2)),
    (Role::E2, "e2", Some(Role::E1)),
    (Role::Weight, "w", None),
    (Role::R11, "R11", Some(Role::R22)),
    (Role::R22, "R22", Some(Role::R11)),
    (Role::R12, "R12", Some(Role::R21)),
    (Role::R21, "R21", Some(Role::R12)),
    (Role::Dw1, "dw1", Some(Role::Dw2)),
    (Role::Dw2, "dw2", Some(Role::Dw1)),
    (Role::RmsE, "rms_e", None),
    (Role::SigmaE, "sigma_e", None),
    (Role::KsbE1, "ksb_e1", Some(Role::KsbE2)),
    (Role::KsbE2, "ksb_e2", Some(Role::KsbE1)),
    (Role::Flag, "flag", None),
    (Role::G1, "g1", Some(Role::G2)),
    (Role::G2, "g2", Some(Role::G1)),
    (Role::Psf1, "psf_e1", None),
    (Role::Psf2, "psf_e2", None),
    (Role::PsfSize, "psf_size", None),
    (Role::Id, "id", None),
    (Role::X, "x", None),
    (Role::Y, "y", None),
    (Role::Unit, "unit", None),
    (Role::ShearedCatalogue, "version", None),
    (Role::M, "m", None),
    (Role::C1, "c1", None),
    (Role::C2, "c2", None),
];

/// All columns that `--columns` can name, in its order: the roles, then ellipticities under artificial shears of the own component
/// and of the other one.
pub fn keys() -> impl Iterator<Item = Key> {
    let pairs = [[0, 0], [1, 1], [0, 1], [1, 0]];
    let sheared = pairs.into_iter().flat_map(|[of, by]| sheared_pair(of, by));
    TABLE.iter().map(|row| (row.0, 0)).chain(sheared)
}

pub fn name_of((role, catalogue): Key) -> String {
    let name = TABLE[role as usize].1;
    match catalogue.checked_sub(1) {
        None => name.to_owned(),
        Some(sheared) => format!("{name}_{}", SHEARED_CATALOGUES[sheared].0),
    }
}

pub fn role_names() -> String {
    keys().map(name_of).collect::<Vec<_>>().join(", ")
}

pub fn named(name: &str) -> Option<Key> {
    keys().find(|key| name_of(*key) == name)
}

/// The column without which this one is incomplete: the other component, or the opposite artificial shear.
pub fn partner((role, catalogue): Key) -> Option<Key> {
    match catalogue {
        0 => TABLE[role as usize].2.map(|partner| (partner, 0)),
        // 1p and 1m, 2p and 2m: one of them alone gives no difference.
        _ => Some((role, ((catalogue - 1) ^ 1) + 1)),
    }
}

/// What is read of a row by sheared catalogue and role, as places in [`Source::wanted`]. A role may have several columns (flags,
/// operands), or in sheared catalogues the column without artificial shear.
#[derive(Debug, Default)]
pub struct Places(pub [[Vec<usize>; ROLES]; CATALOGUES]);

impl Places {
    pub fn all(&self, (role, catalogue): Key) -> &[usize] {
        &self.0[catalogue][role as usize]
    }

    pub fn of(&self, key: Key) -> Option<usize> {
        self.all(key).first().copied()
    }

    /// Of two roles in the catalogue without artificial shear, if both have a column.
    pub fn pair(&self, [a, b]: [Role; 2]) -> Option<[usize; 2]> {
        Some([self.of((a, 0))?, self.of((b, 0))?])
    }

    pub fn set(&mut self, (role, catalogue): Key, places: Vec<usize>) {
        self.0[catalogue][role as usize] = places;
    }
}
