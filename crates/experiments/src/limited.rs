//! One measurement in a process of its own, so that neither a long run nor a crash takes the others with it.

use anyhow::{Context, Result, bail};
use serde::de::DeserializeOwned;
use std::io::Read;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Runs this program again with other arguments and reads what it prints as JSON.
///
/// # Errors
/// A run beyond the limit (it is ended), one that fails, or output that is not the JSON of a `T`.
pub fn run_again<T: DeserializeOwned>(arguments: &[String], limit: Duration) -> Result<T> {
    let program = std::env::current_exe().context("this program's own path")?;
    let mut command = Command::new(program);
    command.args(arguments);
    serde_json::from_str(&output_within(command, limit)?).context("the row's own output is no result")
}

/// What a command prints within a time.
///
/// # Errors
/// A command that cannot be started, fails, or takes longer.
pub fn output_within(mut command: Command, limit: Duration) -> Result<String> {
    let begun = Instant::now();
    let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::inherit()).spawn()?;
    let mut pipe = child.stdout.take().context("a pipe to the command")?;
    let reader = std::thread::spawn(move || {
        let mut text = String::new();
        pipe.read_to_string(&mut text).map(|_| text)
    });
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        if begun.elapsed() > limit {
            child.kill()?;
            child.wait()?;
            bail!("no answer within {} s", limit.as_secs());
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    let text = reader.join().map_err(|_| anyhow::anyhow!("reading its output failed"))??;
    if !status.success() {
        bail!("ended with {status}");
    }
    Ok(text)
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    fn shell(script: &str) -> Command {
        let mut command = Command::new("sh");
        command.args(["-c", script]);
        command
    }

    #[test]
    fn output_comes_back_and_a_long_or_failing_command_is_an_error() {
        let second = Duration::from_secs(10);
        assert_eq!(output_within(shell("echo 1"), second).unwrap(), "1\n");
        assert!(output_within(shell("exit 3"), second).is_err());
        let error = output_within(shell("exec sleep 20"), Duration::from_millis(100)).unwrap_err();
        assert!(error.to_string().contains("no answer"), "{error}");
    }
}
