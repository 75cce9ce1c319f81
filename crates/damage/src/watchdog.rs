//! Ends the process when an input hangs: a test cannot stop a reader that does not return.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// What is being read, since when.
#[derive(Clone, Default)]
pub(crate) struct Watchdog(Arc<Mutex<Option<(Instant, PathBuf)>>>);

impl Watchdog {
    /// Watches; an input that takes longer than `hangs` is left where it lies.
    pub(crate) fn start(hangs: Duration) -> Self {
        let watchdog = Watchdog::default();
        let seen = Arc::downgrade(&watchdog.0);
        std::thread::spawn(move || {
            while let Some(reading) = seen.upgrade() {
                if let Some((since, path)) = &*reading.lock().unwrap_or_else(PoisonError::into_inner)
                    && since.elapsed() > hangs
                {
                    eprintln!("no answer after {hangs:?}; the input is {}", path.display());
                    std::process::abort();
                }
                drop(reading);
                std::thread::sleep(Duration::from_millis(500));
            }
        });
        watchdog
    }

    pub(crate) fn begin(&self, path: &Path) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some((Instant::now(), path.to_owned()));
    }

    pub(crate) fn end(&self) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }
}
