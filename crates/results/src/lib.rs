//! What happens to scores: catalogues become [`score::ScoredSet`]s, of which [`row`] keeps what tables, stores
//! and comparisons need.
//!
//! [`mean`] takes means of catalogues, [`foreign`] reads other programs' catalogues; [`store`] keeps rows in Parquet files, [`conditions`] and
//! [`groups`] choose among them and put them together; [`compare`] holds results against each other, and
//! [`baseline`] against what they were. [`submit`] packs and checks what is sent to a challenge;
//! [`views`] are the tables, plots and pages.

pub mod baseline;
pub mod compare;
pub mod conditions;
pub mod foreign;
pub mod groups;
pub mod mean;
pub mod row;
pub mod score;
pub mod store;
pub mod submit;
pub mod views;
