//! Progress on a terminal, and the clock that the libraries do not read.

use cpu_time::ProcessTime;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;
use skclam::progress::{Progress, Stage};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Set by Ctrl-C.
static STOP: AtomicBool = AtomicBool::new(false);

/// Lets Ctrl-C end a run at its next step. A second Ctrl-C ends the program at once.
pub fn watch_for_interrupt() {
    let installed = ctrlc::set_handler(|| {
        if STOP.swap(true, Ordering::SeqCst) {
            std::process::exit(130);
        }
    });
    // Without a handler Ctrl-C still ends the program; only a hidden folder may stay behind.
    drop(installed);
}

/// How long a stage took.
#[derive(Debug, Clone, Serialize)]
pub struct StageTime {
    /// The stage's name.
    pub stage: String,
    /// Steps: images, pairs, ...
    pub steps: u64,
    /// Wall-clock seconds.
    pub wall_s: f64,
    /// CPU seconds over all threads.
    pub cpu_s: f64,
}

struct Running {
    stage: Stage,
    steps: u64,
    wall: Instant,
    cpu: ProcessTime,
}

/// One calm line: stage, bar, count, time left.
pub struct Screen {
    bar: ProgressBar,
    state: Mutex<(Option<Running>, Vec<StageTime>)>,
}

impl Screen {
    /// Draws on standard error if it is a terminal and `quiet` is off.
    pub fn new(quiet: bool) -> Self {
        let target = if quiet { ProgressDrawTarget::hidden() } else { ProgressDrawTarget::stderr_with_hz(8) };
        let bar = ProgressBar::with_draw_target(Some(0), target);
        let style = ProgressStyle::with_template("{msg:>10} [{bar:30}] {pos}/{len}  {per_sec}  {eta} left");
        if let Ok(style) = style {
            bar.set_style(style.progress_chars("=> "));
        }
        Screen { bar, state: Mutex::new((None, Vec::new())) }
    }

    /// Ends the current stage and gives the times of all.
    pub fn finish(&self) -> Vec<StageTime> {
        self.bar.finish_and_clear();
        let mut state = self.state.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        close(&mut state);
        state.1.clone()
    }
}

fn close(state: &mut (Option<Running>, Vec<StageTime>)) {
    if let Some(running) = state.0.take() {
        let time = StageTime {
            stage: running.stage.to_string(),
            steps: running.steps,
            wall_s: running.wall.elapsed().as_secs_f64(),
            cpu_s: running.cpu.elapsed().as_secs_f64(),
        };
        // A stage that was taken up again is one stage.
        match state.1.iter_mut().find(|earlier| earlier.stage == time.stage) {
            None => state.1.push(time),
            Some(earlier) => {
                earlier.steps += time.steps;
                earlier.wall_s += time.wall_s;
                earlier.cpu_s += time.cpu_s;
            }
        }
    }
}

impl Progress for Screen {
    fn begin(&self, stage: Stage, total: u64) {
        let mut state = self.state.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        close(&mut state);
        state.0 = Some(Running { stage, steps: total, wall: Instant::now(), cpu: ProcessTime::now() });
        self.bar.reset();
        self.bar.set_length(total);
        self.bar.set_message(stage.to_string());
    }

    fn step(&self) {
        self.bar.inc(1);
    }

    fn stop_requested(&self) -> bool {
        STOP.load(Ordering::Relaxed)
    }
}

/// The largest resident set of this process so far, MiB; `None` where the system does not tell.
pub fn peak_memory_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kib: f64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kib / 1024.0)
}
