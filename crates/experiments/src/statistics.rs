//! The few statistics that the tables need.

/// Arithmetic mean; NaN of nothing.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Root of the mean square; NaN of nothing.
pub fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|value| value * value).sum::<f64>() / values.len() as f64).sqrt()
}

/// Sample standard deviation; NaN of fewer than two values.
pub fn sd(values: &[f64]) -> f64 {
    let center = mean(values);
    (values.iter().map(|value| (value - center).powi(2)).sum::<f64>() / (values.len() as f64 - 1.0)).sqrt()
}

/// Median; NaN of nothing.
pub fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => f64::NAN,
        count if count % 2 == 1 => sorted[count / 2],
        count => 0.5 * (sorted[count / 2 - 1] + sorted[count / 2]),
    }
}

/// Central 95 % interval of chi squared over its degrees of freedom (Wilson and Hilferty's approximation, better than 1
/// % from 5 degrees on).
pub fn chi_squared_band(degrees: usize) -> [f64; 2] {
    let spread = 2.0 / (9.0 * degrees as f64);
    [-1.959_964, 1.959_964].map(|z| (1.0 - spread + z * spread.sqrt()).max(0.0).powi(3))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_band_is_that_of_the_tables() {
        // chi squared with 10 degrees of freedom: 3.247 and 20.483; with 600: 534.0 and 669.8.
        for (degrees, expected) in [(10, [3.247, 20.483]), (600, [534.019, 669.769])] {
            let band = chi_squared_band(degrees);
            for (found, expected) in band.iter().zip(expected) {
                assert!((found * degrees as f64 / expected - 1.0).abs() < 0.01, "{degrees}: {found}");
            }
        }
    }

    #[test]
    fn means_and_medians() {
        let values = [4.0, 1.0, 3.0];
        assert_eq!(median(&values), 3.0);
        assert_eq!(median(&values[..2]), 2.5);
        assert!((sd(&values) - (7.0f64 / 3.0).sqrt()).abs() < 1e-12);
        assert!((rms(&[3.0, 4.0]) - 12.5f64.sqrt()).abs() < 1e-12);
        assert!(median(&[]).is_nan());
    }
}
