//! Random numbers that depend on what they are for, not on who asked first.
//!
//! A stream is named by the seed, the number of the processed scan, the particle and the purpose;
//! so results do not depend on the number of threads or on what was drawn before.

use rand::{RngCore as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// What random numbers are drawn for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// The motion model.
    Motion = 0,
    /// Systematic resampling.
    Resampling = 1,
    /// The proposal around the matched pose.
    Proposal = 2,
}

/// A source of independent streams.
#[derive(Debug, Clone)]
pub struct Streams(ChaCha8Rng);

impl Streams {
    /// The streams of `seed`.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    fn stream(&self, purpose: Purpose, step: u64, particle: usize) -> ChaCha8Rng {
        let mut rng = self.0.clone();
        rng.set_stream((step << 2) | purpose as u64);
        rng.set_word_pos((particle as u128) << 8);
        rng
    }

    /// A number in [0, 1).
    #[must_use]
    pub fn uniform(&self, purpose: Purpose, step: u64, particle: usize) -> f64 {
        uniform(&mut self.stream(purpose, step, particle))
    }

    /// A stream of standard normal numbers.
    #[must_use]
    pub fn gaussian(&self, purpose: Purpose, step: u64, particle: usize) -> Gaussian {
        Gaussian { rng: self.stream(purpose, step, particle), spare: None }
    }
}

fn uniform(rng: &mut ChaCha8Rng) -> f64 {
    const BITS: u32 = 53;
    (rng.next_u64() >> (64 - BITS)) as f64 / (1_u64 << BITS) as f64
}

/// Standard normal numbers (Box and Muller 1958), the same on every platform.
#[derive(Debug, Clone)]
pub struct Gaussian {
    rng: ChaCha8Rng,
    spare: Option<f64>,
}

impl Gaussian {
    /// The next number.
    pub fn draw(&mut self) -> f64 {
        if let Some(spare) = self.spare.take() {
            return spare;
        }
        let radius = (-2.0 * libm::log(1.0 - uniform(&mut self.rng))).sqrt();
        let (sin, cos) = libm::sincos(std::f64::consts::TAU * uniform(&mut self.rng));
        self.spare = Some(radius * sin);
        radius * cos
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_differ_by_every_part_of_their_name() {
        let draw = |seed, purpose, step, particle| {
            Streams::new(seed).gaussian(purpose, step, particle).draw()
        };
        let first = draw(1, Purpose::Motion, 1, 1);
        assert_eq!(first, draw(1, Purpose::Motion, 1, 1));
        for other in [
            draw(2, Purpose::Motion, 1, 1),
            draw(1, Purpose::Proposal, 1, 1),
            draw(1, Purpose::Motion, 2, 1),
            draw(1, Purpose::Motion, 1, 2),
        ] {
            assert_ne!(first, other);
        }
    }

    #[test]
    fn gaussians_are_standard_normal() {
        let streams = Streams::new(7);
        let n = 20_000;
        let (mut sum, mut squares, mut beyond_two) = (0.0, 0.0, 0);
        for step in 0..n / 2 {
            let mut gaussian = streams.gaussian(Purpose::Motion, step, 3);
            for value in [gaussian.draw(), gaussian.draw()] {
                sum += value;
                squares += value * value;
                beyond_two += usize::from(value.abs() > 2.0);
            }
        }
        let n = n as f64;
        assert!((sum / n).abs() < 0.02, "mean {}", sum / n);
        assert!((squares / n - 1.0).abs() < 0.03, "variance {}", squares / n);
        assert!((beyond_two as f64 / n - 0.0455).abs() < 0.005);
    }
}
