//! What may be allocated: every allocation of a test that links this crate is counted and, beyond the limit, refused,
//! which ends the process. Pages that nobody touched count too: a reader that trusts a length is caught on any machine.

use cap::Cap;
use std::alloc::System;

#[global_allocator]
static ALLOCATOR: Cap<System> = Cap::new(System, usize::MAX);

/// Allows so many bytes more than are allocated now.
pub(crate) fn allow_more(bytes: usize) {
    let _ = ALLOCATOR.set_limit(ALLOCATOR.allocated().saturating_add(bytes));
}

/// Takes the limit away before a panic's message is made, which takes more than most readers may.
pub(crate) fn allow_all_to_panics() {
    static ONCE: std::sync::Once = std::sync::Once::new();
    ONCE.call_once(|| {
        let previous = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            allow_all();
            previous(panic);
        }));
    });
}

/// Takes the limit away.
pub(crate) fn allow_all() {
    let _ = ALLOCATOR.set_limit(usize::MAX);
}

/// The most that this process had allocated at a time, MiB. Without what C libraries allocate.
pub(crate) fn peak_allocated_mib() -> f64 {
    ALLOCATOR.max_allocated() as f64 / f64::from(1 << 20)
}

/// The largest resident set of this process, MiB: with C libraries and stacks. `None` where the system does not say.
pub fn peak_resident_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    line.split_whitespace().nth(1)?.parse::<f64>().ok().map(|kib| kib / 1024.0)
}
