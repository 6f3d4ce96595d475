// SPDX-License-Identifier: MIT OR Apache-2.0
//! A part's process, as its parent sees it; and the messages of the part.

use crate::Result;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Value, from_value};
use std::collections::{BTreeSet, VecDeque};
use std::io::{BufRead, BufReader, PipeWriter, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};
use tautline_rt::domain::scope;

/// The longest wait: an operation that takes longer hangs.
pub const PATIENCE: Duration = Duration::from_secs(20);
/// Maximum of mapped files of dead processes: an endpoint that is not used keeps the mappings of its last use.
pub const HELD_BY_IDLE: usize = 32;
/// Number of lines of all parts' standard error that are kept.
const LINES: usize = 200;

/// The last lines that parts wrote to standard error.
#[derive(Clone)]
pub struct Complaints {
    lines: Arc<Mutex<VecDeque<String>>>,
    pipe: Arc<PipeWriter>,
}

impl Complaints {
    pub fn collect() -> Result<Self> {
        let (reader, writer) = std::io::pipe()?;
        let lines = Arc::new(Mutex::new(VecDeque::new()));
        let kept = lines.clone();
        thread::spawn(move || {
            for line in BufReader::new(reader).lines().map_while(std::io::Result::ok) {
                let mut kept = lock(&kept);
                if kept.len() == LINES {
                    kept.pop_front();
                }
                kept.push_back(line);
            }
        });
        Ok(Complaints { lines, pipe: Arc::new(writer) })
    }

    /// The lines, to find the cause of a failure.
    pub fn text(&self) -> String {
        // Waits for lines that were written a moment ago.
        thread::sleep(Duration::from_millis(50));
        let heading = "what the processes said last:\n".to_owned();
        lock(&self.lines).iter().fold(heading, |text, line| text + "  " + line + "\n")
    }
}

/// Locks a mutex, also if its holder panicked.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The domain in this process's scope in which parts of this program run.
#[derive(Clone)]
pub struct Stage {
    pub domain: u32,
    pub complaints: Complaints,
}

impl Stage {
    pub fn command(&self, part: &str, seed: u64) -> Result<Command> {
        let mut command = Command::new(std::env::current_exe()?);
        command.args(["part", part, "--seed", &seed.to_string()]).stderr(self.complaints.pipe.try_clone()?);
        command.env("TAUT_DOMAIN", self.domain.to_string()).env("TAUT_REALTIME", "off");
        command.envs(scope()?.map(|scope| ("TAUT_SCOPE", scope)));
        Ok(command)
    }

    pub fn start(&self, part: &str) -> Result<Process> {
        let mut process = self.start_without_waiting(part)?;
        process.expect_ready()?;
        Ok(process)
    }

    pub fn start_without_waiting(&self, part: &str) -> Result<Process> {
        let mut command = self.command(part, 0)?;
        Process::start(part, command.stdin(Stdio::piped()).stdout(Stdio::piped()))
    }
}

/// A part that exchanges lines with this process. Killed when it is dropped.
pub struct Process {
    name: String,
    child: Child,
    /// Whether its exit status was already waited for.
    is_reaped: bool,
    input: Option<ChildStdin>,
    lines: Receiver<String>,
}

impl Process {
    fn start(name: &str, command: &mut Command) -> Result<Self> {
        let mut child = command.spawn()?;
        let (input, output) = (child.stdin.take(), child.stdout.take().ok_or("its output is a pipe")?);
        let (sender, lines) = channel();
        thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(std::io::Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        Ok(Process { name: name.into(), child, is_reaped: false, input, lines })
    }

    pub fn id(&self) -> u32 {
        self.child.id()
    }

    pub fn tell(&mut self, line: &str) -> Result<()> {
        let input = self.input.as_mut().ok_or("its input is a pipe")?;
        writeln!(input, "{line}")
            .map_err(|error| format!("the {} is told '{line}': {error}", self.name).into())
    }

    pub fn hear(&mut self) -> Result<Said> {
        let line = self.lines.recv_timeout(PATIENCE);
        let line = line.map_err(|error| self.silence(&error.to_string()))?;
        match serde_json::from_str(&line) {
            Ok(Said::Failed(why)) => Err(format!("the {}: {why}", self.name).into()),
            Ok(said) => Ok(said),
            Err(error) => Err(format!("the {} says '{line}': {error}", self.name).into()),
        }
    }

    /// The next line that it writes within `patience`, unless it ends before.
    pub fn hear_within(&mut self, patience: Duration) -> Option<Said> {
        let line = self.lines.recv_timeout(patience).ok()?;
        serde_json::from_str(&line).ok()
    }

    pub fn expect_ready(&mut self) -> Result<()> {
        match self.hear()? {
            Said::Ready => Ok(()),
            other => Err(format!("the {} says {other:?}", self.name).into()),
        }
    }

    /// Sends it a command, and waits until the command is done.
    pub fn order(&mut self, what: &str) -> Result<()> {
        self.tell(what)?;
        self.expect_ready()
    }

    pub fn ask<T: DeserializeOwned>(&mut self, question: &str) -> Result<T> {
        self.tell(question)?;
        match self.hear()? {
            Said::Answer(answer) => Ok(from_value(answer)?),
            other => Err(format!("the {} is asked '{question}' and says {other:?}", self.name).into()),
        }
    }

    /// The reason why it writes nothing: its exit status, or where its threads wait.
    fn silence(&mut self, error: &str) -> String {
        match self.child.try_wait() {
            Ok(Some(status)) if !self.is_reaped => format!("the {} has ended: {status}", self.name),
            _ => format!("the {} hangs ({error}): {}", self.name, threads(self.id())),
        }
    }

    pub fn kill(&mut self) -> Result<()> {
        self.child.kill()?;
        self.wait()
    }

    fn wait(&mut self) -> Result<()> {
        self.child.wait()?;
        self.is_reaped = true;
        Ok(())
    }

    /// Closes its standard input and waits for its end, which must be a success.
    pub fn finish(&mut self) -> Result<()> {
        drop(self.input.take());
        let start = Instant::now();
        loop {
            match self.child.try_wait()? {
                Some(status) => {
                    self.is_reaped = true;
                    return if status.success() { Ok(()) } else { Err(self.silence("").into()) };
                }
                None if start.elapsed() > PATIENCE => return Err(self.silence("it does not end").into()),
                None => thread::sleep(Duration::from_millis(1)),
            }
        }
    }

    /// Records that its tracer has waited for its exit status.
    pub fn was_reaped(&mut self) {
        self.is_reaped = true;
    }

    pub fn holdings(&self) -> Holdings {
        let process = Path::new("/proc").join(self.id().to_string());
        let maps = std::fs::read_to_string(process.join("maps")).unwrap_or_default();
        let removed = maps.lines().filter_map(|line| line.strip_suffix(" (deleted)")?.rsplit(' ').next());
        Holdings {
            files: crate::place::entries(&process.join("fd")).len(),
            removed: removed
                .filter(|path| path.starts_with(tautline_rt::shm::DIRECTORY))
                .map(str::to_owned)
                .collect(),
        }
    }
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Holdings {
    pub files: usize,
    /// Mapped files that were removed.
    pub removed: BTreeSet<String>,
}

impl Drop for Process {
    fn drop(&mut self) {
        if !self.is_reaped {
            let _ = self.kill();
        }
    }
}

/// Kills a child whose exit status was not waited for.
pub fn kill(pid: u32) -> Result<()> {
    let pid = rustix::process::Pid::from_raw(pid.cast_signed()).ok_or("no process")?;
    Ok(rustix::process::kill_process(pid, rustix::process::Signal::KILL)?)
}

/// The system calls and kernel functions in which the threads of a process wait.
pub fn threads(pid: u32) -> String {
    let read = |path: &Path, file: &str| {
        std::fs::read_to_string(path.join(file)).map(|text| text.trim().to_owned()).unwrap_or_default()
    };
    let mut text = String::new();
    for task in crate::place::entries(Path::new(&format!("/proc/{pid}/task"))) {
        let call = read(&task, "syscall");
        text += &format!("\n  {} in {} ({})", read(&task, "comm"), read(&task, "wchan"), call);
    }
    text
}

#[derive(Debug, Serialize, Deserialize)]
pub enum Said {
    Ready,
    Failed(String),
    Answer(Value),
    /// A step of a scene has been reached.
    At(String),
}

/// For a part: sends a message to its parent.
pub fn say(said: &Said) {
    let line = serde_json::to_string(said).unwrap_or_default();
    println!("{line}");
}

/// For a part: answers a question.
pub fn answer(answer: &impl Serialize) {
    say(&match serde_json::to_value(answer) {
        Ok(answer) => Said::Answer(answer),
        Err(error) => Said::Failed(error.to_string()),
    });
}

/// For a part: the commands of its parent, until the parent has ended or closes the pipe.
pub fn told() -> impl Iterator<Item = String> {
    std::io::stdin().lines().map_while(std::io::Result::ok)
}

pub fn wait(what: &str, patience: Duration, mut is_so: impl FnMut() -> Result<bool>) -> Result<()> {
    let start = Instant::now();
    while !is_so()? {
        if start.elapsed() > patience {
            return Err(format!("waited {patience:?} for {what}").into());
        }
        thread::sleep(Duration::from_millis(1));
    }
    Ok(())
}

pub fn ms(time: Duration) -> String {
    format!("{:.1} ms", time.as_secs_f64() * 1e3)
}
