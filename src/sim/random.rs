//! Seeded random numbers that are the same on every platform.

use std::f64::consts::TAU;

use rand::{Rng, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// What a generator is for: each purpose draws from a stream of its own, so drawing more for one
/// changes nothing for another.
#[derive(Debug, Clone, Copy)]
pub(super) enum Purpose {
    World = 1,
    People = 2,
    Lidar = 3,
    Odometry = 4,
}

/// The generator of `purpose`; `index` tells apart repeated uses, such as the scans of a run.
pub(super) fn generator(seed: u64, purpose: Purpose, index: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(index << 3 | purpose as u64);
    rng
}

/// A draw from the normal distribution with mean 0 and standard deviation 1 (Box-Muller).
pub(super) fn gaussian(rng: &mut impl Rng) -> f64 {
    let radius = (-2.0 * libm::log(1.0 - rng.random::<f64>())).sqrt();
    radius * libm::cos(TAU * rng.random::<f64>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaussian_has_mean_0_and_variance_1() {
        let mut rng = generator(1, Purpose::World, 0);
        let draws: Vec<f64> = (0..20_000).map(|_| gaussian(&mut rng)).collect();
        let mean = draws.iter().sum::<f64>() / draws.len() as f64;
        let variance = draws.iter().map(|d| (d - mean) * (d - mean)).sum::<f64>() / 20_000.0;
        assert!(mean.abs() < 0.02, "mean {mean}");
        assert!((variance - 1.0).abs() < 0.03, "variance {variance}");
    }

    #[test]
    fn purposes_and_indices_have_streams_of_their_own() {
        let first = |purpose, index| generator(7, purpose, index).random::<u64>();
        assert_eq!(first(Purpose::Lidar, 3), first(Purpose::Lidar, 3));
        assert_ne!(first(Purpose::Lidar, 3), first(Purpose::Lidar, 4));
        assert_ne!(first(Purpose::Lidar, 3), first(Purpose::Odometry, 3));
    }
}
