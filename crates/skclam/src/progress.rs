//! How a long run reports how far it is, and how it is asked to stop.

use std::fmt;

/// The stages of a run, in the paper's order (section 3).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Stage {
    /// Taking the postures out of a recording.
    Import,
    /// Judging a dataset.
    Inspect,
    /// Rendering the virtual cell.
    Simulate,
    /// Writing a data set as a recording.
    Record,
    /// Detecting and describing keypoints, section 3.2.
    ExtractFeatures,
    /// Looking for the rig's board.
    FindBoards,
    /// Matching pairs of images, section 3.2.
    MatchPairs,
    /// Joining matches to tracks and refining them.
    BuildTracks,
    /// Estimating the rig, section 3.3.
    Calibrate,
    /// Looking for the gross mistake in a recording that its rig does not explain.
    FindCause,
    /// Fitting without some postures and judging on them.
    HoldOut,
    /// Measuring a rig on a recording that it was not fitted to.
    Validate,
    /// Fusing the depth images, section 4.1.2.
    Map,
    /// Summing up what the report shows.
    Report,
    /// Comparing with a known truth.
    Evaluate,
    /// Writing a result as a recording.
    Export,
}

impl fmt::Display for Stage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Stage::Import => "import",
            Stage::Inspect => "inspect",
            Stage::Simulate => "simulate",
            Stage::Record => "record",
            Stage::ExtractFeatures => "features",
            Stage::FindBoards => "boards",
            Stage::MatchPairs => "match",
            Stage::BuildTracks => "tracks",
            Stage::Calibrate => "calibrate",
            Stage::FindCause => "causes",
            Stage::HoldOut => "hold out",
            Stage::Validate => "validate",
            Stage::Map => "map",
            Stage::Report => "report",
            Stage::Evaluate => "evaluate",
            Stage::Export => "export",
        })
    }
}

/// What a run reports to while it works. All methods may be called from several threads.
pub trait Progress: Sync {
    /// A stage begins that has `total` steps.
    fn begin(&self, stage: Stage, total: u64);
    /// One more step of the current stage is done.
    fn step(&self);
    /// Whether the run should stop; asked often, and answered by ending with an error and no half-written result.
    fn stop_requested(&self) -> bool;
}

/// Reports to nobody and never stops.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Progress for Silent {
    fn begin(&self, _: Stage, _: u64) {}
    fn step(&self) {}
    fn stop_requested(&self) -> bool {
        false
    }
}
