//! What a run left behind, read back.

use crate::ReportError;
use serde_json::Value;
use skclam::report_data::{FORMAT, ReportData};
use skclam::summary::Summary;
use std::fs;
use std::path::Path;

/// The part of a result folder that reports are made of.
#[derive(Debug, Clone, PartialEq)]
pub struct RunResult {
    /// For people: the folder's name.
    pub name: String,
    /// `summary.json`; it holds what a [`Summary`] holds.
    pub summary: Value,
    /// `report_data.json`; `None` where an older run wrote none.
    pub data: Option<ReportData>,
}

impl RunResult {
    /// Reads a result folder.
    ///
    /// # Errors
    /// Where `summary.json` is missing or is none, where `report_data.json` is damaged or of an unknown format.
    pub fn read(folder: impl AsRef<Path>) -> Result<Self, ReportError> {
        let folder = folder.as_ref();
        skclam_files::verify(folder)?;
        let path = folder.join("summary.json");
        let text = skclam_files::read_text(&path, skclam_files::Kind::Summary)
            .map_err(|source| ReportError::Io { path: path.clone(), source })?;
        let content = |error: serde_json::Error| ReportError::Content {
            path: path.clone(),
            problem: format!("is no summary of a run: {error}"),
        };
        // Read as what it should be first, so that nothing below has to ask for each field whether it is there.
        serde_json::from_str::<Summary>(&text).map_err(content)?;
        let summary: Value = serde_json::from_str(&text).map_err(content)?;
        let name = fs::canonicalize(folder).ok();
        let name = name.as_deref().unwrap_or(folder).file_name().map(|name| name.to_string_lossy().into_owned());
        Ok(RunResult { name: name.unwrap_or_else(|| folder.display().to_string()), summary, data: data(folder)? })
    }

    /// A metric of the summary by its JSON pointer; `None` where it was not measured: without matches there is no
    /// distance to a line, though the summary holds the 0 of an empty list.
    pub fn metric(&self, pointer: &str) -> Option<&Value> {
        let of_matches = pointer.starts_with("/calibration/epipolar_");
        let no_matches = || self.summary.pointer("/counts/matches").and_then(Value::as_u64) == Some(0);
        self.summary.pointer(pointer).filter(|value| value.is_number() && !(of_matches && no_matches()))
    }

    /// A metric as a number.
    pub fn number(&self, pointer: &str) -> Option<f64> {
        self.metric(pointer)?.as_f64()
    }

    /// A text of the summary by its JSON pointer; empty where there is none.
    pub fn text(&self, pointer: &str) -> &str {
        self.summary.pointer(pointer).and_then(Value::as_str).unwrap_or_default()
    }

    /// A list of the summary by its JSON pointer; empty where there is none.
    pub fn list(&self, pointer: &str) -> &[Value] {
        self.summary.pointer(pointer).and_then(Value::as_array).map(Vec::as_slice).unwrap_or_default()
    }
}

fn data(folder: &Path) -> Result<Option<ReportData>, ReportError> {
    let path = folder.join("report_data.json");
    let text = match skclam_files::read_text(&path, skclam_files::Kind::ReportData) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(source) => return Err(ReportError::Io { path, source }),
    };
    let problem = |problem: String| ReportError::Content { path: path.clone(), problem };
    // The version alone first: another version may have other fields.
    #[derive(serde::Deserialize)]
    struct Version {
        format: u32,
    }
    let found: Version = serde_json::from_str(&text).map_err(|error| problem(error.to_string()))?;
    if found.format != FORMAT {
        return Err(problem(format!(
            "has the format {}, this program reads {FORMAT}; run the calibration again",
            found.format
        )));
    }
    let data: ReportData = serde_json::from_str(&text).map_err(|error| problem(error.to_string()))?;
    check(&data).map_err(problem)?;
    Ok(Some(data))
}

/// Lists that belong together have one length, and indices name what exists.
fn check(data: &ReportData) -> Result<(), String> {
    let postures = data.postures.len();
    let same = |what: &str, got: usize, need: usize| {
        if got == need { Ok(()) } else { Err(format!("{what}: {got} entries where {need} are needed")) }
    };
    same("residuals.postures", data.residuals.postures.len(), postures)?;
    let histogram = &data.residuals.histogram;
    same("residuals.histogram.before", histogram.before.len() + 1, histogram.edges_px.len())?;
    same("residuals.histogram.after", histogram.after.len() + 1, histogram.edges_px.len())?;
    let indices = data.residuals.pairs.iter().flat_map(|pair| [pair.a, pair.b]);
    for index in indices.chain(data.images.iter().flat_map(|image| [image.a, image.b])) {
        if index >= postures {
            return Err(format!("posture {index} is named, and there are {postures}"));
        }
    }
    if let Some(map) = &data.map {
        let arrays = [
            ("map.nominal_m", &map.nominal_m, 12),
            ("map.calibrated_m", &map.calibrated_m, 12),
            ("map.colors", &map.colors, 3),
            ("map.postures", &map.postures, 2),
            ("map.point_to_plane_nominal_mm", &map.point_to_plane_nominal_mm, 4),
            ("map.point_to_plane_calibrated_mm", &map.point_to_plane_calibrated_mm, 4),
        ];
        for (what, packed, bytes) in arrays {
            let got = packed.bytes().ok_or_else(|| format!("{what} is no base64"))?.len();
            same(what, got, map.points * bytes)?;
        }
    }
    for image in &data.images {
        if image.images.iter().any(|image| image.jpeg.bytes().is_none()) {
            return Err("an image is no base64".to_owned());
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn without_matches_there_is_no_distance_to_a_line() {
        let run = |matches: u64| RunResult {
            name: String::new(),
            summary: json!({"counts": {"matches": matches}, "calibration": {"epipolar_after": {"median_px": 0.0}}}),
            data: None,
        };
        let pointer = "/calibration/epipolar_after/median_px";
        assert_eq!((run(0).number(pointer), run(1).number(pointer)), (None, Some(0.0)));
        assert_eq!(run(0).number("/counts/matches"), Some(0.0));
    }
}
