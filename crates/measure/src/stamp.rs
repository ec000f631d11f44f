//! A stamp before its shape is measured, and the sky that is subtracted from it.

use ndarray::ArrayView2;
use shearq_submissions::SkySource;

use crate::error::MeasureError;
use crate::pixels::{Pixel, copy_row};
use crate::sky::{Sky, SkyCells};

/// A full stamp in single precision and the sky that is subtracted from it, with buffers for one thread.
#[derive(Debug, Clone)]
pub(crate) struct FullStamp {
    pub(crate) side: usize,
    pub(crate) pixels: Vec<f32>,
    pub(crate) cells: SkyCells,
    pub(crate) subtraction: SkySubtraction,
}

impl FullStamp {
    pub(crate) fn new(side: usize) -> Self {
        FullStamp {
            side,
            pixels: vec![0.0; side * side],
            cells: SkyCells::new(side),
            subtraction: SkySubtraction::Nothing,
        }
    }

    pub(crate) fn read<P: Pixel>(&mut self, stamp: ArrayView2<'_, P>) -> Result<(), MeasureError> {
        let side = self.side;
        if stamp.dim() != (side, side) {
            let expected = format!("{side} × {side}");
            return Err(MeasureError::square("a stamp", stamp.dim(), expected));
        }
        let rows = self.pixels.chunks_exact_mut(side.max(1));
        for (to, row) in rows.zip(stamp.into_outer_iter()) {
            copy_row(row, to);
        }
        Ok(())
    }

    /// Whether all pixels are equal, as on a stamp beyond the exposure.
    pub(crate) fn is_blank(&self) -> bool {
        self.pixels.iter().all(|value| *value == self.pixels[0])
    }

    /// Missing pixels stay missing.
    pub(crate) fn subtract_sky(&mut self) {
        let sky = match self.subtraction {
            SkySubtraction::Nothing => None,
            SkySubtraction::Plane(sky) => Some(sky),
            SkySubtraction::EachStamp => self.cells.plane_of(&self.pixels),
        };
        if let Some(sky) = sky {
            sky.subtract(&mut self.pixels, self.side);
        }
    }
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) enum SkySubtraction {
    #[default]
    Nothing,
    Plane(Sky),
    /// The plane of each stamp, measured on its border.
    EachStamp,
}

impl SkySubtraction {
    /// What a configuration with this key subtracts if `sky` was found.
    pub(crate) fn of(source: Option<SkySource>, sky: Option<Sky>) -> Self {
        match (source, sky) {
            (Some(SkySource::Stamp), _) => SkySubtraction::EachStamp,
            (Some(SkySource::Image), Some(sky)) => SkySubtraction::Plane(sky),
            (Some(SkySource::Image | SkySource::None) | None, _) => SkySubtraction::Nothing,
        }
    }
}
