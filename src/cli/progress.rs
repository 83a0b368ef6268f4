//! How far a replay is, on standard error.

use std::io::IsTerminal as _;
use std::time::Duration;

use gmapd::clock::Stopwatch;
use gmapd::logs::LogStatistics;
use gmapd::slam::pose::Stamp;
use indicatif::{ProgressBar, ProgressStyle};

/// Where nobody watches, a line this often.
const LINE_PERIOD: Duration = Duration::from_secs(5);

/// Readings between two looks at the clock.
const STRIDE: u64 = 16;

/// Says how many readings are done and how much faster than the robot that goes.
pub(super) struct Progress {
    bar: Option<ProgressBar>,
    watch: Stopwatch,
    next_line: Duration,
    total: u64,
    done: u64,
    first_stamp: Stamp,
    last_stamp: Stamp,
}

impl Progress {
    pub(super) fn new(log: &LogStatistics) -> Self {
        let first_stamp = log.stamps.map_or(Stamp(0), |(first, _)| first);
        Self {
            bar: std::io::stderr().is_terminal().then(|| bar(log.readings)),
            watch: Stopwatch::start(),
            next_line: LINE_PERIOD,
            total: log.readings,
            done: 0,
            first_stamp,
            last_stamp: first_stamp,
        }
    }

    pub(super) fn advance(&mut self, stamp: Stamp) {
        self.done += 1;
        self.last_stamp = self.last_stamp.max(stamp);
        if !self.done.is_multiple_of(STRIDE) {
            return;
        }
        let wall = self.watch.elapsed().wall;
        if let Some(bar) = &self.bar {
            bar.set_position(self.done);
            bar.set_message(self.speed(wall));
        } else if wall >= self.next_line {
            self.next_line = wall + LINE_PERIOD;
            eprintln!("{} of {} readings, {}", self.done, self.total, self.speed(wall));
        }
    }

    pub(super) fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }

    fn speed(&self, wall: Duration) -> String {
        let log_time = self.last_stamp.seconds_since(self.first_stamp);
        let factor = log_time / wall.as_secs_f64().max(1e-9);
        format!("{log_time:.0} s of log, {factor:.0} times real time")
    }
}

fn bar(total: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{wide_bar} {pos}/{len} readings, {msg}")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(total).with_style(style)
}
