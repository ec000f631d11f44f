//! Plots of the processing steps of a measurement, as in Fig. 3 of the paper.

use shearq_measure::Steps;

use shearq_render::figure::{ColourMap, ImageGrid, ImagePanel, ImageRow, Stretch};

/// One galaxy: stamp, PSF, deconvolved stamp, residual, ACF, and the part of the ACF that is measured.
pub fn steps_row(label: &str, steps: Steps) -> ImageRow {
    use ColourMap::{Diverging, Viridis};
    let panel = |title: &str, image, map, stretch| ImagePanel {
        title: title.into(),
        image,
        map,
        stretch,
    };
    ImageRow {
        label: label.into(),
        panels: vec![
            panel("Stamp", steps.stamp, Viridis, Stretch::Linear),
            panel("PSF", steps.psf, Viridis, Stretch::Asinh),
            panel("Deconvolved", steps.deconvolved, Viridis, Stretch::Linear),
            panel("Residual", steps.residual, Diverging, Stretch::Linear),
            panel("ACF", steps.acf, Viridis, Stretch::Linear),
            panel("ACF used", steps.used, Viridis, Stretch::Linear),
        ],
    }
}

/// Several galaxies under a title, which ends with the version.
pub fn steps_figure(title: &str, rows: Vec<ImageRow>) -> ImageGrid {
    ImageGrid {
        title: format!("{title} (shearq {})", shearq_dataset::VERSION),
        rows,
    }
}
