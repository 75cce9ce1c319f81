//! A reader on trial.

use crate::memory::{allow_all, allow_all_to_panics, allow_more, peak_allocated_mib, peak_resident_mib};
use crate::watchdog::Watchdog;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Inputs a reader in a plain `cargo test`.
const FEW: u64 = 300;
/// No input may take longer.
const MAX_TIME: Duration = Duration::from_secs(5);
/// After so long an input is taken to hang.
const HANGS: Duration = Duration::from_secs(20);

/// A whole file that the damage begins with.
#[derive(Debug, Clone)]
pub struct Seed {
    /// The file's name; readers go by its ending.
    pub name: String,
    /// What is in it.
    pub bytes: Vec<u8>,
}

impl Seed {
    /// A seed.
    pub fn new(name: impl Into<String>, bytes: impl Into<Vec<u8>>) -> Self {
        Seed { name: name.into(), bytes: bytes.into() }
    }
}

/// A reader, what it is given, and what it may cost.
pub struct Trial<'a> {
    /// For people and for `SKCLAM_FUZZ_ONLY`.
    pub reader: &'a str,
    /// Whole files, taken in turn.
    pub seeds: &'a [Seed],
    /// An input of a seed; by its place among the seeds.
    pub damage: &'a dyn Fn(usize, &mut ChaCha8Rng) -> Vec<u8>,
    /// Puts an input where the path says: a file, or a folder of files.
    pub lay_down: &'a dyn Fn(&Path, &[u8]),
    /// Reads, and all that follows from a file that can be read: whether it could.
    pub read: &'a dyn Fn(&Path) -> bool,
    /// Bytes that may be allocated for an input of this length.
    pub max_allocated: &'a dyn Fn(usize) -> usize,
    /// The largest resident set of the process, MiB.
    pub max_resident_mib: f64,
}

/// Holds the allocator's limit and the clock for one reader at a time, as tests run side by side.
fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

fn setting(variable: &str, default: u64) -> u64 {
    std::env::var(variable).ok().and_then(|text| text.parse().ok()).unwrap_or(default)
}

/// How inputs were answered.
#[derive(Default)]
struct Answers {
    read: u64,
    refused: u64,
    slowest: Duration,
}

impl Trial<'_> {
    /// Reads every seed, then as many damaged ones as the environment says, and prints a line.
    ///
    /// # Panics
    /// Where a seed is refused, an input makes the reader panic or takes too long; that input is kept and named. A
    /// reader that hangs or allocates too much ends the process; its input stays where it lay, and is named for a hang.
    pub fn run(&self) {
        let only = std::env::var("SKCLAM_FUZZ_ONLY").unwrap_or_default();
        if !self.reader.contains(&only) {
            return;
        }
        let _alone = alone();
        allow_all_to_panics();
        let folder = tempfile::Builder::new().prefix("damaged-").tempdir().expect("a folder for damaged files");
        let watchdog = Watchdog::start(HANGS);
        for seed in self.seeds {
            let path = folder.path().join(&seed.name);
            (self.lay_down)(&path, &seed.bytes);
            assert!((self.read)(&path), "{}: the seed {} itself is refused", self.reader, seed.name);
        }
        let (count, begin) = (setting("SKCLAM_FUZZ", FEW), setting("SKCLAM_FUZZ_SEED", 1));
        let max_time = Duration::from_secs(setting("SKCLAM_FUZZ_SECONDS", 1800));
        let start = Instant::now();
        let mut answers = Answers::default();
        for case in 0..count {
            if start.elapsed() > max_time {
                break;
            }
            self.try_case(begin, case, folder.path(), &watchdog, &mut answers);
        }
        let tried = answers.read + answers.refused;
        let resident = peak_resident_mib();
        println!(
            "{}: {tried} inputs in {:.0} s, {} read, {} refused; slowest {:.0} ms; at most {:.0} MiB allocated, {:.0} MiB resident",
            self.reader,
            start.elapsed().as_secs_f64(),
            answers.read,
            answers.refused,
            answers.slowest.as_secs_f64() * 1e3,
            peak_allocated_mib(),
            resident.unwrap_or(f64::NAN),
        );
        assert!(tried < 100 || (answers.read > 0 && answers.refused > 0), "{}: nothing was tried", self.reader);
        let most = self.max_resident_mib;
        assert!(resident.is_none_or(|peak| peak < most), "{}: more than {most} MiB resident", self.reader);
    }

    fn try_case(&self, begin: u64, case: u64, folder: &Path, watchdog: &Watchdog, answers: &mut Answers) {
        let mut random = ChaCha8Rng::seed_from_u64(begin.wrapping_mul(1 << 40).wrapping_add(case));
        let index = (case % self.seeds.len() as u64) as usize;
        let name = &self.seeds[index].name;
        let bytes = (self.damage)(index, &mut random);
        let path = folder.join(name);
        (self.lay_down)(&path, &bytes);
        let keep = || -> PathBuf {
            let kept = std::env::temp_dir().join(format!("finding-{begin}-{case}-{name}"));
            std::fs::write(&kept, &bytes).expect("the finding is kept");
            kept
        };
        watchdog.begin(&path);
        let start = Instant::now();
        allow_more((self.max_allocated)(bytes.len()));
        let answer = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| (self.read)(&path)));
        allow_all();
        let took = start.elapsed();
        watchdog.end();
        match answer {
            Ok(true) => answers.read += 1,
            Ok(false) => answers.refused += 1,
            Err(_) => panic!("{}, input {case}: a panic; it is kept as {}", self.reader, keep().display()),
        }
        answers.slowest = answers.slowest.max(took);
        assert!(took < MAX_TIME, "{}, input {case}: {took:?}; it is kept as {}", self.reader, keep().display());
    }
}
