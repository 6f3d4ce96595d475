// SPDX-License-Identifier: MIT OR Apache-2.0
//! System files.

use tautline_analysis::file::SystemFile;

/// What a made-up file consists of: each byte of the input is one of these.
const PIECES: [&str; 62] = [
    "\n",
    " = ",
    "\"",
    ", ",
    "[",
    "]",
    "{ ",
    " }",
    "a",
    "b",
    "t",
    "g",
    "[hosts.a]\ncores = 2\n",
    "[hosts.b]\ncores = [1]\n",
    "[nodes.a]\n",
    "[nodes.b]\n",
    "[overheads]\n",
    "[network]\nlatency = [\"1ms\", \"5ms\"]\n",
    "[priorities]\n",
    "[topics]\n",
    "[groups.g]\n",
    "[callbacks.a]\n",
    "[callbacks.b]\n",
    "[callbacks.c]\n",
    "[[chains]]\nname = \"k\"\npath = [\"a\", \"b\"]\ndeadline = \"1s\"\n",
    "t = { period = \"10ms\", remote = true }\n",
    "u = { period = \"7ms\", jitter = \"9ms\" }\n",
    "host = \"a\"\n",
    "host = \"b\"\n",
    "core = 0\n",
    "core = 1\n",
    "core = \"any\"\n",
    "node = \"a\"\n",
    "node = \"b\"\n",
    "period = \"10ms\"\n",
    "period = \"3ns\"\n",
    "wcet = \"1ms\"\n",
    "wcet = \"18446744073709551614ns\"\n",
    "bcet = \"1ms\"\n",
    "jitter = \"100s\"\n",
    "min_distance = \"1ms\"\n",
    "topic = \"t\"\n",
    "topic = [\"t\", \"u\"]\n",
    "all = [\"t\", \"u\"]\n",
    "window = \"20ms\"\n",
    "policy = \"latest_time\"\n",
    "publishes = \"v\"\n",
    "publishes = \"t\"\n",
    "reads = \"v\"\n",
    "topic = \"v\"\n",
    "group = \"g\"\n",
    "order = \"any\"\n",
    "overrun = \"demote\"\n",
    "overrun = \"suspend\"\n",
    "reservation = { runtime = \"1ms\", period = \"10ms\" }\n",
    "locks = [{ resource = \"r\", length = \"1ms\" }]\n",
    "non_preemptive = \"1ms\"\n",
    "priority = 95\n",
    "stall = \"10s\"\n",
    "gateway = \"1ms\"\nper_message = \"60us\"\n",
    "client = \"rclcpp\"\n",
    "throttling = { period = \"10ms\", runtime = \"1ms\" }\n",
];

/// Reads a system file, of any bytes or of pieces of files, and analyses what it describes.
pub fn system(input: &[u8]) {
    let Some((kind, rest)) = input.split_first() else { return };
    let text = match kind % 2 {
        0 => String::from_utf8_lossy(rest).into_owned(),
        _ => rest.iter().map(|byte| PIECES[usize::from(*byte) % PIECES.len()]).collect(),
    };
    // The work grows with the callbacks, by design; long files are none of what can go wrong here.
    if text.len() > 4_096 {
        return;
    }
    match SystemFile::parse(&text) {
        Ok(file) => {
            let checked = file.check();
            let unbounded = checked.callbacks.iter().any(|callback| callback.response_overhead_ns.is_none());
            assert!(!unbounded || (!checked.schedulable && !checked.warnings.is_empty()), "{text}");
        }
        Err(problems) => {
            assert!(!problems.0.is_empty());
            for problem in &problems.0 {
                assert!(!problem.message.chars().any(char::is_control), "{:?}", problem.message);
            }
        }
    }
}
