// SPDX-License-Identifier: MIT OR Apache-2.0
//! The Python process with rclpy, also for the tests of the generated types.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use tautline_schema::TypeName;

/// A process that runs `ros_values.py`.
pub struct Peer {
    child: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
}

impl Peer {
    pub fn start(venv: &Path) -> Self {
        let mut folders = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
        let script = folders.find_map(|folder| {
            Some(folder.join("msgs/schema/tests/ros_values.py")).filter(|script| script.is_file())
        });
        let mut command = Command::new(venv.join("bin/python"));
        command
            .arg(script.unwrap())
            .env_remove("LD_LIBRARY_PATH")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let (input, output) = (child.stdin.take().unwrap(), child.stdout.take().unwrap());
        Self { child, input, output: BufReader::new(output) }
    }

    fn line(&mut self) -> String {
        let mut line = String::new();
        let read = self.output.read_line(&mut line).unwrap();
        assert!(read > 0, "the Python process ended: see its output above");
        line.trim_end().to_owned()
    }

    /// Random messages: the bytes and the JSON of each.
    pub fn messages(&mut self, name: &TypeName, count: usize, seed: u64) -> Vec<(Vec<u8>, String)> {
        writeln!(self.input, "{name} {count} {seed}").unwrap();
        let message = |_| {
            let line = self.line();
            let (cdr, json) = line.split_once(' ').unwrap();
            assert_ne!(cdr, "skip", "{name}: rclpy does not have it: {json}");
            (unhex(cdr), json.to_owned())
        };
        (0..count).map(message).collect()
    }

    /// Sends a line `<cdr as hex> <yaml as JSON string>` per message; gives `ok` or what differs.
    pub fn answer(&mut self, lines: &str) -> String {
        self.input.write_all(lines.as_bytes()).unwrap();
        self.line()
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn unhex(text: &str) -> Vec<u8> {
    let digits: Vec<u8> = text.chars().map(|digit| digit.to_digit(16).unwrap() as u8).collect();
    digits.chunks(2).map(|pair| pair[0] << 4 | pair[1]).collect()
}
