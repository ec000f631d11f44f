//! Tables, plots and HTML pages, for any contents.
//!
//! * [`table`]: rows and columns, as text for a terminal, Markdown, LaTeX, CSV or JSON; [`terminal`] fits them to a width.
//! * [`figure`]: curves, points with errors, and images, as SVG and PNG.
//! * [`html`], [`page`]: pages that need no other file.
//! * [`escape`]: text of unknown origin, made safe for each format.
#![forbid(unsafe_code)]

pub mod escape;
pub mod figure;
mod formats;
pub mod html;
pub mod page;
pub mod table;
pub mod terminal;

// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
