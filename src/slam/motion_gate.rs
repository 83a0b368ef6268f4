//! Which scans are worth processing: those taken after enough motion or time.

use super::odometry::Motion;

/// Thresholds on the motion since the last processed scan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionGate {
    /// `linearUpdate`: metres of path.
    pub linear_update: f64,
    /// `angularUpdate`: radians turned, whatever the direction.
    pub angular_update: f64,
    /// `temporalUpdate`: seconds between stamps; `None` (a negative value in the file) is off.
    pub temporal_update: Option<f64>,
}

impl Default for MotionGate {
    fn default() -> Self {
        Self { linear_update: 1.0, angular_update: 0.5, temporal_update: None }
    }
}

impl MotionGate {
    /// Whether a scan is processed after `motion` and, in seconds, `elapsed` since the last one;
    /// the first scan always is.
    #[must_use]
    pub fn opens(&self, motion: &Motion, elapsed: Option<f64>) -> bool {
        let Some(elapsed) = elapsed else { return true };
        motion.path_length >= self.linear_update
            || motion.turned >= self.angular_update
            || self.temporal_update.is_some_and(|limit| elapsed > limit)
    }
}
