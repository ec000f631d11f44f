//! Point-spread functions: star stamps and functional forms.
pub mod functional;
pub mod star;
