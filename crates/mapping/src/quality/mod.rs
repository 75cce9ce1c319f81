//! How good a map is: how well the views agree among themselves, and how far it is from a reference surface.

mod depth_consistency;
mod reference;

pub use depth_consistency::{
    DepthConsistency, DepthConsistencyOptions, PairConsistency, PointToPlaneSample, depth_consistency,
};
pub use reference::{DistanceSummary, ReferenceOptions, SCORE_THRESHOLDS_M, SurfaceScore, score_surface};

/// The value below which a fraction of a list lies; the list is reordered. `None` for an empty list.
fn quantile(values: &mut [f32], fraction: f64) -> Option<f64> {
    let last = values.len().checked_sub(1)?;
    let place = (fraction * last as f64).round() as usize;
    let (_, value, _) = values.select_nth_unstable_by(place, f32::total_cmp);
    Some(f64::from(*value))
}

#[cfg(test)]
mod tests {
    #[test]
    fn quantiles_are_values_of_the_list() {
        let mut values = [5.0, 1.0, 3.0, 2.0, 4.0];
        assert_eq!(super::quantile(&mut values, 0.5), Some(3.0));
        assert_eq!(super::quantile(&mut values, 1.0), Some(5.0));
        assert_eq!(super::quantile(&mut [], 0.5), None);
    }
}
