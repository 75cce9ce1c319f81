//! Time steps of fast explicit diffusion.
//!
//! An explicit scheme of diffusion is stable for steps up to `tau_max` (1/4 for the five-point stencil). One FED
//! cycle of `n` steps `tau_j = tau_max / (2 cos^2(pi (2j + 1) / (4n + 2)))` is stable although some of its steps are
//! larger, and reaches the time `tau_max (n^2 + n) / 3` (Grewenig, Weickert, Bruhn, DAGM 2010). The smallest `n` that
//! reaches the wanted time is taken and its steps shrunk to end on it exactly.

/// Largest stable step of the explicit scheme in two dimensions.
const TAU_MAX: f64 = 0.25;

/// The steps of one cycle of total time `time`, ordered so that rounding errors do not grow.
pub(crate) fn time_steps(time: f64) -> Vec<f32> {
    if time <= 0.0 {
        return Vec::new();
    }
    let n = ((3.0 * time / TAU_MAX + 0.25).sqrt() - 0.5 - 1e-8).ceil().max(1.0) as usize;
    let reached = TAU_MAX * (n * n + n) as f64 / 3.0;
    let steps: Vec<f64> = (0..n)
        .map(|j| {
            let c = (std::f64::consts::PI * (2 * j + 1) as f64 / (4 * n + 2) as f64).cos();
            time / reached * TAU_MAX / (2.0 * c * c)
        })
        .collect();
    kappa_order(n).into_iter().map(|j| steps[j] as f32).collect()
}

/// A permutation of `0..n` that mixes small and large steps: multiples of `n / 2` modulo the next prime above `n`.
fn kappa_order(n: usize) -> Vec<usize> {
    let kappa = (n / 2).max(1);
    let is_prime = |p: usize| p > 1 && (2..).take_while(|d| d * d <= p).all(|d| !p.is_multiple_of(d));
    let prime = (n + 1..).find(|&p| is_prime(p)).expect("there is a prime above every number");
    (1..prime).map(|k| k * kappa % prime - 1).filter(|&j| j < n).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_end_on_the_time_and_are_as_few_as_can_be() {
        for time in [0.01, 0.25, 0.53, 1.06, 4.2, 17.0, 68.0] {
            let steps = time_steps(time);
            let sum: f64 = steps.iter().map(|&t| f64::from(t)).sum();
            assert!((sum - time).abs() < 1e-5 * time, "{time}: {sum}");
            let n = steps.len();
            assert!(TAU_MAX * ((n * n + n) as f64) / 3.0 >= time * (1.0 - 1e-6));
            assert!(n == 1 || TAU_MAX * ((n * n - n) as f64) / 3.0 < time);
        }
    }

    #[test]
    fn the_order_is_a_permutation() {
        for n in 1..60 {
            let mut order = kappa_order(n);
            order.sort_unstable();
            assert_eq!(order, (0..n).collect::<Vec<_>>());
        }
    }

    #[test]
    fn no_time_needs_no_step() {
        assert!(time_steps(0.0).is_empty());
    }
}
