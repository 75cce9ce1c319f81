//! How much may be unpacked: a few hundred bytes of a compressor can unpack to gigabytes of nothing, and hours of
//! reading.

use crate::bytes::Problem;

/// Bytes that may come out of nearly none: seconds of black images.
const BASE: u64 = 256 << 20;
/// Bytes that each compressed byte may bring besides; recordings with colour images bring less than ten.
const PER_BYTE: u64 = 200;

/// Bytes that decompressors may still bring in one pass through a recording.
#[derive(Debug)]
pub(crate) struct Budget {
    left: u64,
}

impl Default for Budget {
    fn default() -> Self {
        Budget { left: BASE }
    }
}

impl Budget {
    /// What may come out of so many compressed bytes; they are counted once.
    pub fn earn(&mut self, compressed: u64) -> u64 {
        self.left = self.left.saturating_add(compressed.saturating_mul(PER_BYTE));
        self.left
    }

    /// Takes what came out, or is announced.
    pub fn spend(&mut self, bytes: u64) -> Result<(), Problem> {
        self.left = self.left.checked_sub(bytes).ok_or_else(|| {
            let problem = format!(
                "{bytes} bytes are said to be compressed here, far more than recordings hold in so few: at most {PER_BYTE} for each byte, and {} MiB, are unpacked",
                BASE >> 20
            );
            Problem::Damaged(problem)
        })?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_compresses_to_hours_of_reading() {
        let mut budget = Budget::default();
        budget.earn(1 << 20);
        budget.spend(BASE).unwrap();
        budget.spend(200 << 20).unwrap();
        assert!(budget.spend(1).is_err());
        let mut bomb = Budget::default();
        bomb.earn(262_144);
        assert!(bomb.spend(8 << 30).is_err());
    }
}
