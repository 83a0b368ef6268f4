//! Weights, effective sample size and adaptive systematic resampling.

/// How many independent measurements a scan is worth, whatever the number of its beams.
///
/// Neighbouring beams hit the same surfaces and share the map's errors; taken as independent they
/// would let one particle win at each scan. Divided by `ogain`.
const INDEPENDENT_BEAMS: f64 = 12.0;

/// How weights are formed and when particles are drawn anew.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weighting {
    /// `ogain`: the larger, the flatter the weights.
    pub flatness: f64,
    /// What the weights are flattened by.
    pub smoothing: WeightSmoothing,
    /// `resampleThreshold`: resample below this fraction of N effective particles.
    pub resample_threshold: f64,
}

impl Default for Weighting {
    fn default() -> Self {
        Self { flatness: 3.0, smoothing: WeightSmoothing::Fixed, resample_threshold: 0.5 }
    }
}

/// How log likelihoods become weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WeightSmoothing {
    /// A scan counts the same for any number of particles and of beams.
    Fixed,
    /// Divided by `ogain * N`: the original's rule, by which many particles hardly ever resample.
    PerParticle,
}

impl Weighting {
    /// What a unit of a scan's log likelihood adds to a particle's log weight.
    #[must_use]
    pub fn gain(&self, particles: usize, beams: usize) -> f64 {
        match self.smoothing {
            WeightSmoothing::Fixed => INDEPENDENT_BEAMS / (self.flatness * beams as f64),
            WeightSmoothing::PerParticle => 1.0 / (self.flatness * particles as f64),
        }
    }
}

/// Normalised weights of log weights; they sum to one.
#[must_use]
pub fn normalize(log_weights: &[f64]) -> Vec<f64> {
    let max = log_weights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let mut weights: Vec<f64> =
        log_weights.iter().map(|log_weight| libm::exp(log_weight - max)).collect();
    let sum: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|weight| *weight /= sum);
    weights
}

/// 1 / Σ wᵢ² of normalised weights: between 1 and their number (Liu 1996).
#[must_use]
pub fn effective_sample_size(weights: &[f64]) -> f64 {
    1.0 / weights.iter().map(|weight| weight * weight).sum::<f64>()
}

/// −Σ wᵢ ln wᵢ of normalised weights: the entropy of the posterior over particles, nats.
#[must_use]
pub fn entropy(weights: &[f64]) -> f64 {
    -weights.iter().filter(|weight| **weight > 0.0).map(|w| w * libm::log(*w)).sum::<f64>()
}

/// Systematic resampling: for each new particle, in order, the index of its ancestor.
///
/// `uniform` in [0, 1) is the only random number. Particle i is drawn ⌊N wᵢ⌋ or ⌈N wᵢ⌉ times and
/// N wᵢ times on average.
#[must_use]
pub fn systematic(weights: &[f64], uniform: f64) -> Vec<usize> {
    let n = weights.len();
    let mut ancestor = 0;
    let mut cumulative = weights[0];
    (0..n)
        .map(|i| {
            let target = (i as f64 + uniform) / n as f64;
            while cumulative <= target && ancestor + 1 < n {
                ancestor += 1;
                cumulative += weights[ancestor];
            }
            ancestor
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::{prop_assert, proptest};

    use super::*;

    proptest! {
        #[test]
        fn weights_sum_to_one(
            log_weights in proptest::collection::vec(-1e6..1e6_f64, 1..200),
        ) {
            let weights = normalize(&log_weights);
            prop_assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-12);
            let n_eff = effective_sample_size(&weights);
            prop_assert!((1.0 - 1e-9..=weights.len() as f64 + 1e-9).contains(&n_eff));
            prop_assert!(entropy(&weights) <= libm::log(weights.len() as f64) + 1e-9);
        }

        #[test]
        fn each_ancestor_is_drawn_its_share(
            log_weights in proptest::collection::vec(-5.0..0.0_f64, 1..50),
            uniform in 0.0..1.0_f64,
        ) {
            let weights = normalize(&log_weights);
            let n = weights.len() as f64;
            let ancestors = systematic(&weights, uniform);
            for (i, weight) in weights.iter().enumerate() {
                let drawn = ancestors.iter().filter(|a| **a == i).count() as f64;
                prop_assert!((drawn - n * weight).abs() < 1.0 + 1e-9);
            }
        }
    }

    #[test]
    fn resampling_is_unbiased() {
        let weights = [0.07, 0.4, 0.0, 0.23, 0.3];
        let mut drawn = [0_u32; 5];
        let rounds = 10_000;
        for round in 0..rounds {
            for ancestor in systematic(&weights, f64::from(round) / f64::from(rounds)) {
                drawn[ancestor] += 1;
            }
        }
        for (count, weight) in drawn.iter().zip(weights) {
            let mean = f64::from(*count) / f64::from(rounds);
            assert!((mean - 5.0 * weight).abs() < 1e-3, "{mean} of {}", 5.0 * weight);
        }
    }

    #[test]
    fn a_scan_counts_alike_for_any_number_of_particles_and_beams() {
        let fixed = Weighting::default();
        assert_eq!(fixed.gain(30, 180) * 180.0, fixed.gain(1000, 1080) * 1080.0);
        let original = Weighting { smoothing: WeightSmoothing::PerParticle, ..fixed };
        assert_eq!(original.gain(30, 180), 1.0 / 90.0);
    }

    #[test]
    fn equal_weights_keep_every_particle() {
        assert_eq!(systematic(&[0.25; 4], 0.999), [0, 1, 2, 3]);
        assert_eq!(effective_sample_size(&[0.25; 4]), 4.0);
        assert_eq!(systematic(&[1.0], 0.5), [0]);
    }
}
