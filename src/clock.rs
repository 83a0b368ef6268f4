//! The only place that reads clocks and what the process uses.

use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};

/// What this machine's clock says, as the stamps of messages count: nanoseconds since 1970.
#[must_use]
pub fn unix_nanoseconds() -> i64 {
    let time = clock_gettime(ClockId::Realtime);
    time.tv_sec.saturating_mul(1_000_000_000).saturating_add(time.tv_nsec)
}

/// The time now, to compare with other times of this process.
#[must_use]
#[allow(clippy::disallowed_methods, reason = "this module is where clocks are read")]
pub fn now() -> Instant {
    Instant::now()
}

/// Wall time and the process's CPU time, all threads together.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Elapsed {
    /// Time that passed.
    pub wall: Duration,
    /// Time that processors worked for this process.
    pub cpu: Duration,
}

/// Measures wall and CPU time from where it was started.
#[derive(Debug, Clone, Copy)]
pub struct Stopwatch {
    wall: Instant,
    cpu: Duration,
}

impl Stopwatch {
    /// Starts now.
    #[must_use]
    #[allow(clippy::disallowed_methods, reason = "this module is where clocks are read")]
    pub fn start() -> Self {
        Self { wall: Instant::now(), cpu: process_cpu_time() }
    }

    /// What has passed since the start.
    #[must_use]
    pub fn elapsed(&self) -> Elapsed {
        Elapsed { wall: self.wall.elapsed(), cpu: process_cpu_time().saturating_sub(self.cpu) }
    }

    /// What has passed since the start or the last lap, and starts anew.
    pub fn lap(&mut self) -> Elapsed {
        let now = Self::start();
        let elapsed = Elapsed {
            wall: now.wall.duration_since(self.wall),
            cpu: now.cpu.saturating_sub(self.cpu),
        };
        *self = now;
        elapsed
    }
}

/// The most memory this process has had resident, bytes; `None` where the system does not say.
#[must_use]
pub fn peak_resident_memory() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    parse_peak(&status)
}

fn parse_peak(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kibibytes * 1024)
}

fn process_cpu_time() -> Duration {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    let seconds = u64::try_from(time.tv_sec).unwrap_or(0);
    Duration::from_secs(seconds) + Duration::from_nanos(u64::try_from(time.tv_nsec).unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_peak_is_read_from_the_status_file() {
        let status = "Name:\tgmapd\nVmPeak:\t  9000 kB\nVmHWM:\t    1824 kB\n";
        assert_eq!(parse_peak(status), Some(1824 * 1024));
        assert_eq!(parse_peak("Name:\tgmapd\n"), None);
    }

    #[test]
    fn work_takes_time() {
        let mut stopwatch = Stopwatch::start();
        let sum: u64 = std::hint::black_box((0..2_000_000_u64).map(std::hint::black_box).sum());
        let lap = stopwatch.lap();
        assert!(sum > 0 && lap.wall > Duration::ZERO && lap.cpu > Duration::ZERO);
    }
}
