//! How curves and their samples in legends are drawn.

/// How a series is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Style {
    /// A line through the points.
    #[default]
    Line,
    /// A disc at each point, without a line.
    Points,
    /// A dashed line through the points.
    Dashed,
}
