//! The images of a set, added up in groups for the jackknife.

use ndarray::ArrayView2;

use crate::catalogue::FieldSum;
use crate::error::ScoringError;
use crate::grid::{Grid, check_shape};
use crate::resample::MAX_GROUPS;

/// Sums of a set's images, kept in up to [`MAX_GROUPS`] groups so that each can be left out.
///
/// Image `k` (counted from 0 in the order added) belongs to group `k mod MAX_GROUPS`. Two configurations
/// measured on the same images are therefore grouped alike. Memory does not grow with the images.
#[derive(Debug, Clone)]
pub struct SetImages {
    groups: Vec<FieldSum>,
    total: FieldSum,
}

impl SetImages {
    /// No images yet.
    pub fn new(grid: &Grid) -> Self {
        SetImages {
            groups: Vec::new(),
            total: FieldSum::new(grid),
        }
    }

    /// Images given as e₁ and e₂ on the cells `[ix, iy]`. A galaxy counts as missing if one of its components
    /// is not finite.
    ///
    /// # Errors
    /// If the shape of an array differs from the grid.
    pub fn of_arrays<'a>(
        grid: &Grid,
        images: impl IntoIterator<Item = [ArrayView2<'a, f64>; 2]>,
    ) -> Result<Self, ScoringError> {
        let mut all = SetImages::new(grid);
        for [e1, e2] in images {
            check_shape("e1 of an image", &e1, grid.n)?;
            check_shape("e2 of an image", &e2, grid.n)?;
            let mut sum = FieldSum::new(grid);
            sum.images = 1;
            for ((cell, &e1), &e2) in e1.indexed_iter().zip(&e2) {
                if e1.is_finite() && e2.is_finite() {
                    (sum.e1[cell], sum.e2[cell], sum.count[cell]) = (e1, e2, 1.0);
                }
            }
            all.add(&sum)?;
        }
        Ok(all)
    }

    /// Adds one image.
    ///
    /// # Errors
    /// If `image` is a sum of no image or of several, or if the shape of one of its arrays differs from the
    /// grid.
    pub fn add(&mut self, image: &FieldSum) -> Result<(), ScoringError> {
        if image.images != 1 {
            return Err(ScoringError::NotOneImage(image.images));
        }
        let side = self.total.e1.nrows();
        check_shape("e1 of an image", &image.e1, side)?;
        check_shape("e2 of an image", &image.e2, side)?;
        check_shape("the count of an image", &image.count, side)?;
        let group = self.total.images % MAX_GROUPS;
        if group == self.groups.len() {
            self.groups.push(image.clone());
        } else {
            self.groups[group].merge(image);
        }
        self.total.merge(image);
        Ok(())
    }

    /// The sums of the groups.
    pub fn groups(&self) -> &[FieldSum] {
        &self.groups
    }

    /// The sum of all images.
    pub fn total(&self) -> &FieldSum {
        &self.total
    }
}
