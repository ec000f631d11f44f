//! Ellipticities and responses of many stamps.
#![expect(clippy::print_stdout, reason = "an example shows what it finds")]

use ndarray::Array3;
use shearq_measure::{FunctionalPsf, Measurer, PsfProfile, Psfs, Shear, ShearSum};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // Stand-ins for your images: a star, and galaxies of which every other is elongated along x.
    let star = FunctionalPsf::new(PsfProfile::Kolmogorov, 3.4, Shear::ZERO)?.stamp(48);
    let stamps = Array3::from_shape_fn((20, 48, 48), |(k, y, x)| {
        let (y, x) = (y as f32 - 23.5, x as f32 - 23.5);
        100.0 * (-(x * x / (10.0 + 4.0 * (k % 2) as f32) + y * y / 10.0)).exp()
    });

    let measurer = Measurer::named("48/linear/star", 48)?;
    let batch = measurer.batch(stamps.view(), &Psfs::star(star.view()), Some(1.0))?;
    let mut sum = ShearSum::default();
    for galaxy in batch.galaxies.iter().filter(|g| g.flags.is_empty()) {
        println!("e = ({:+.3}, {:+.3})", galaxy.e1, galaxy.e2);
        sum.add(
            [galaxy.e1, galaxy.e2],
            galaxy.response.ok_or("no response")?,
            1.0,
        );
    }
    let mean = sum.mean()?;
    println!("shear {:+.3?} ± {:.3?}", mean.shear, mean.error());
    assert!(mean.shear[0] > 0.0 && batch.galaxies[1].e1 > batch.galaxies[0].e1);
    Ok(())
}
