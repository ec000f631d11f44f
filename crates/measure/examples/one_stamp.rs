//! The ellipticity of one stamp.
#![expect(clippy::print_stdout, reason = "an example shows what it finds")]

use ndarray::Array2;
use shearq_measure::{FunctionalPsf, Measurer, PsfProfile, Shear};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // Stand-ins for your images: a star, and a galaxy that is elongated along x.
    let star = FunctionalPsf::new(PsfProfile::Kolmogorov, 3.4, Shear::ZERO)?.stamp(48);
    let stamp = Array2::from_shape_fn((48, 48), |(y, x)| {
        let (y, x) = (y as f64 - 23.5, x as f64 - 23.5);
        100.0 * (-(x * x / 14.0 + y * y / 10.0)).exp()
    });

    let measurer = Measurer::named("48/linear/star", 48)?;
    let galaxy = measurer.stamp(stamp.view(), star.view(), Some(1.0))?;
    println!("e = ({:+.3}, {:+.3})", galaxy.e1, galaxy.e2);
    println!("its own response: {:.2?}", galaxy.response);
    println!("flags: {:?}", galaxy.flags.iter().collect::<Vec<_>>());
    assert!(galaxy.flags.is_empty() && galaxy.e1 > 0.05 && galaxy.e2.abs() < 0.01);
    Ok(())
}
