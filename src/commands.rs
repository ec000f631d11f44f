//! One file per command; `published` is shared by several.

pub(crate) mod baseline;
pub(crate) mod bench;
pub(crate) mod bias;
pub(crate) mod calibrate;
pub(crate) mod challenge;
pub(crate) mod check;
pub(crate) mod compare;
pub(crate) mod completions;
pub(crate) mod gather;
pub(crate) mod mean;
pub(crate) mod measure;
pub(crate) mod merge;
pub(crate) mod pack;
pub(crate) mod published;
pub(crate) mod quickstart;
pub(crate) mod reproduce;
pub(crate) mod run;
pub(crate) mod score;
pub(crate) mod select;
pub(crate) mod shear;
pub(crate) mod show;
pub(crate) mod simulate;
pub(crate) mod study;
pub(crate) mod submissions;
pub(crate) mod unpack;
