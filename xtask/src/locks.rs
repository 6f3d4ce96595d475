// SPDX-License-Identifier: MIT OR Apache-2.0
//! No function of a `hot.rs` reaches a lock that does not inherit priority: the calls between functions are read from the machine code of test
//! executables, from each function of a module `hot` on. Calls through pointers (trait objects, wakers) are not followed.

use crate::build::TARGETS;
use crate::lints;
use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};

/// The test executables that are read: each crate's test of its real-time calls has this name.
const TESTS: &str = "allocations";

/// Where the standard library's locks wait.
const LOCKS: [&str; 3] = ["futex::Mutex>::lock_contended", "futex::Mutex::lock_contended", "futex::RwLock"];

/// What may call a lock, with the reason.
const EXEMPT: [&str; 3] = [
    // The end of the program.
    "core::panicking::",
    "core::result::unwrap_failed",
    // A log line, of a fault or a growth, is registered once; clippy keeps logging out of hot.rs itself.
    "tracing_core::callsite::",
];

/// Reads the test executables of a build of these packages.
pub fn check(packages: &str) -> Result<(), String> {
    if cfg!(not(target_arch = "x86_64")) {
        return Err("the machine code of x86-64 alone can be read".to_owned());
    }
    let executables = lints::executables(&mut lints::json(&format!("{packages} {TARGETS}")))?;
    let executables = executables.into_iter().filter(|built| built.is_test && built.target == TESTS);
    let executables: Vec<_> = executables.map(|built| built.path).collect();
    let mut faults = BTreeSet::new();
    let mut hot = 0;
    for executable in &executables {
        let calls = Calls::read(executable).map_err(|why| format!("{}: {why}", executable.display()))?;
        if !calls.names.values().any(|name| name.contains(LOCKS[0]) || name.contains(LOCKS[1])) {
            return Err(format!("{}: no mutex of the standard library is in it", executable.display()));
        }
        // Instructions that are not understood call nothing.
        hot += calls.hot().filter(|hot| calls.callees.contains_key(hot)).count();
        faults.extend(calls.locks().into_iter().map(|path| path.join("\n    called by ")));
    }
    // Names change with compilers.
    if hot < 100 {
        return Err(format!("{hot} functions of hot.rs call others in {executables:?}, which cannot be"));
    }
    println!("{hot} functions of hot.rs call others in {} executables", executables.len());
    match faults.len() {
        0 => Ok(()),
        count => {
            faults.iter().for_each(|fault| println!("  {fault}"));
            Err(format!("{count} ways lead from hot.rs to a lock without priority inheritance: take PiMutex"))
        }
    }
}

/// Which function calls which, by their addresses.
#[derive(Default)]
struct Calls {
    names: BTreeMap<u64, String>,
    callees: HashMap<u64, BTreeSet<u64>>,
}

impl Calls {
    fn read(executable: &Path) -> Result<Self, String> {
        let mut calls = Calls::default();
        run(Command::new("nm").arg("--demangle").arg(executable), |line| {
            let mut words = line.splitn(3, ' ');
            if let (Some(address), Some("t" | "T" | "w" | "W"), Some(name)) =
                (words.next().and_then(hexadecimal), words.next(), words.next())
            {
                calls.names.insert(address, name.to_owned());
            }
        })?;
        // A call to another crate goes through a table, which the loader relocates.
        let mut table = HashMap::new();
        run(Command::new("objdump").arg("--dynamic-reloc").arg(executable), |line| {
            let mut words = line.split_whitespace();
            if let (Some(at), Some("R_X86_64_RELATIVE"), Some(to)) =
                (words.next().and_then(hexadecimal), words.next(), words.next())
                && let Some(to) = to.strip_prefix("*ABS*+0x").and_then(hexadecimal)
            {
                table.insert(at, to);
            }
        })?;
        let mut caller = 0;
        let disassemble = ["--disassemble", "--no-show-raw-insn"];
        run(Command::new("objdump").args(disassemble).arg(executable), |line| {
            if let Some(address) = line.strip_suffix(">:").and_then(|line| line.split_once(" <")) {
                caller = hexadecimal(address.0).unwrap_or(0);
            } else if let Some(to) = callee(line, &table) {
                calls.callees.entry(caller).or_default().insert(to);
            }
        })?;
        Ok(calls)
    }

    fn hot(&self) -> impl Iterator<Item = u64> {
        let is_hot = |name: &str| name.contains("tautline_") && name.contains("::hot::");
        // What drops a type of such a module runs wherever the type is dropped.
        let hot = self.names.iter().filter(move |(_, name)| is_hot(name) && !name.contains("drop_in_place"));
        hot.map(|(address, _)| *address)
    }

    /// A way to each function that locks, from it back to a function of a `hot.rs`.
    fn locks(&self) -> Vec<Vec<String>> {
        let name = |address: u64| self.names.get(&address).map_or("", String::as_str);
        let mut callers: HashMap<u64, Option<u64>> = self.hot().map(|address| (address, None)).collect();
        let (mut queue, mut found) = (self.hot().collect::<VecDeque<_>>(), Vec::new());
        while let Some(caller) = queue.pop_front() {
            for callee in self.callees.get(&caller).into_iter().flatten() {
                if LOCKS.iter().any(|lock| name(*callee).contains(lock)) {
                    let path = std::iter::successors(Some(caller), |address| callers[address]);
                    found.push(path.map(|address| without_hash(name(address)).to_owned()).collect());
                } else if !EXEMPT.iter().any(|exempt| name(*callee).contains(exempt))
                    && !callers.contains_key(callee)
                {
                    callers.insert(*callee, Some(caller));
                    queue.push_back(*callee);
                }
            }
        }
        found
    }
}

/// The function that an instruction calls or jumps to, in another one or in its own.
fn callee(line: &str, table: &HashMap<u64, u64>) -> Option<u64> {
    let (_, instruction) = line.split_once(":\t")?;
    let operand =
        ["callq", "call", "jmpq", "jmp"].iter().find_map(|name| instruction.strip_prefix(name))?.trim_start();
    match operand.strip_prefix('*') {
        None => hexadecimal(operand.split(' ').next()?),
        Some(indirect) => {
            let (_, slot) = indirect.split_once("# ")?;
            table.get(&hexadecimal(slot.split(' ').next()?)?).copied()
        }
    }
}

fn hexadecimal(text: &str) -> Option<u64> {
    u64::from_str_radix(text, 16).ok()
}

fn without_hash(name: &str) -> &str {
    name.rsplit_once("::h").filter(|(_, hash)| hash.len() == 16).map_or(name, |(name, _)| name)
}

/// Each line that a command prints.
fn run(command: &mut Command, mut each: impl FnMut(&str)) -> Result<(), String> {
    let program = command.get_program().to_string_lossy().into_owned();
    let fail = |error: std::io::Error| format!("{program}, of binutils: {error}");
    let mut child = command.stdout(Stdio::piped()).spawn().map_err(fail)?;
    let mut output = child.stdout.take().map(BufReader::new).ok_or("no output")?;
    let mut line = Vec::new();
    while output.read_until(b'\n', &mut line).map_err(fail)? > 0 {
        each(String::from_utf8_lossy(&line).trim_end());
        line.clear();
    }
    match child.wait().map_err(fail)?.success() {
        true => Ok(()),
        false => Err(format!("{program} failed")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calls_are_read_from_instructions() {
        let table = HashMap::from([(0x1505db0, 0x42)]);
        for (line, to) in [
            ("  5c793b:\tcall   5c7000 <std::thread>", Some(0x5c7000)),
            ("  5c793b:\tjmp    5c7a2b <f+0x1b>", Some(0x5c7a2b)),
            ("  5c793b:\tcall   *0xf3e46f(%rip)        # 1505db0 <_DYNAMIC+0x248>", Some(0x42)),
            ("  5c793b:\tcall   *%rax", None),
            ("  5c793b:\tmov    %rax,%rbx", None),
        ] {
            assert_eq!(callee(line, &table), to, "{line}");
        }
    }

    #[test]
    fn a_way_to_a_lock_is_found_through_other_functions() {
        let names = [
            "tautline_x::hot::publish",
            "grow",
            "a::futex::Mutex>::lock_contended",
            "tracing_core::callsite::register",
        ];
        let names = (1..).zip(names.map(str::to_owned)).collect();
        let callees = HashMap::from([(1, [2, 4].into()), (2, [3].into()), (4, [3].into())]);
        let calls = Calls { names, callees };
        assert_eq!(calls.locks(), [["grow", "tautline_x::hot::publish"]]);
    }
}
