//! The report of a calibration: one HTML page that opens from disk, in any current browser, without a network.
//!
//! [`report_html`] makes it of what a run left in its result folder, `summary.json` and `report_data.json`, so that a
//! run and a later `skclam report` give the same bytes. Every metric that the page shows carries the place in
//! `summary.json` that it was taken from ([`charts::Numbers`]); a test reads the page and compares. Charts are
//! plotly.js, which is embedded; [`compare_html`] puts several runs side by side.
//!
//! Text from outside (names of rigs, paths, warnings) is escaped on its way into the page, and the page forbids itself
//! every request by its content security policy.
//!
#![doc = include_str!("../README.md")]

pub mod charts;
mod compare;
mod error;
mod html;
mod judgement;
mod page;
mod result_folder;
mod sections;

pub use compare::{Cell, ComparedRun, Comparison, Group, Row, compare_html};
pub use error::ReportError;
pub use judgement::{Judgement, Status, judge};
pub use page::report_html;
pub use result_folder::RunResult;
