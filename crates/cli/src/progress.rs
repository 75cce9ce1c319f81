//! Progress on a terminal, and the clock that the libraries do not read.

use cpu_time::ProcessTime;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use skclam::progress::{Progress, Stage};
use skclam_files::abandon_everything;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Set by Ctrl-C and SIGTERM.
static STOP: AtomicBool = AtomicBool::new(false);

/// How long a signal waits for results that are being put in their place, and for the removal of unfinished ones.
const ABANDON_TIMEOUT: Duration = Duration::from_millis(700);

/// Lets Ctrl-C, SIGTERM and the end of the terminal end the program at once, whatever it does: what it has under
/// construction is removed, and the exit code is 128 and the signal's number.
pub fn watch_for_interrupt() {
    // Whoever started the program with nohup wants it to outlive the terminal.
    let signals = if hangup_is_ignored() { &[SIGINT, SIGTERM][..] } else { &[SIGINT, SIGTERM, SIGHUP][..] };
    // Without a handler signals still end the program; only a hidden folder may stay behind.
    let Ok(mut signals) = Signals::new(signals) else { return };
    std::thread::spawn(move || {
        let Some(signal) = signals.forever().next() else { return };
        STOP.store(true, Ordering::SeqCst);
        let rest = match abandon_everything(ABANDON_TIMEOUT) {
            true => "",
            false => "; the next command that writes there removes what is left",
        };
        crate::screen::note!("error: interrupted{rest}");
        std::process::exit(128 + signal);
    });
}

/// Leaves the end of the program to the signal that came, if one did.
pub fn wait_if_interrupted() {
    while STOP.load(Ordering::SeqCst) {
        std::thread::park();
    }
}

fn hangup_is_ignored() -> bool {
    let Ok(status) = std::fs::read_to_string("/proc/self/status") else { return false };
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).is_some_and(|mask| mask & 1 == 1)
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

/// The largest resident set of this process so far, MiB; `None` where the system does not say.
pub fn peak_memory_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kib: f64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kib / 1024.0)
}
