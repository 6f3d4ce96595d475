// SPDX-License-Identifier: MIT OR Apache-2.0
//! A host as described by its files: this host, or a copy of the /proc, /sys, /etc and /run of another one.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use tautline::CoreSet;

/// The files of a host.
pub struct Tree {
    root: PathBuf,
}

impl Tree {
    pub fn new(root: PathBuf) -> Self {
        Tree { root }
    }

    /// Whether these are the files of this host, so that operations can be tried instead of read.
    pub fn is_here(&self) -> bool {
        self.root == Path::new("/")
    }

    /// The path of `/path` in this tree.
    pub fn path(&self, path: &str) -> PathBuf {
        self.root.join(path.trim_start_matches('/'))
    }

    pub fn has(&self, path: &str) -> bool {
        self.path(path).exists()
    }

    /// A file's text, without white space around it.
    pub fn read(&self, path: &str) -> Result<String, String> {
        let text = fs::read(self.path(path)).map_err(|error| unreadable(path, &error))?;
        Ok(String::from_utf8_lossy(&text).trim().to_owned())
    }

    /// As [`read`](Self::read); `None` if there is no such file.
    pub fn read_if_there(&self, path: &str) -> Result<Option<String>, String> {
        match fs::symlink_metadata(self.path(path)) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            _ => self.read(path).map(Some),
        }
    }

    /// Parses a file's text.
    pub fn parse<T: FromStr>(&self, path: &str) -> Result<T, String> {
        let text = self.read(path)?;
        text.parse().map_err(|_| format!("{path} is '{text}'"))
    }

    pub fn cores(&self, path: &str) -> Result<CoreSet, String> {
        let text = self.read(path)?;
        CoreSet::parse(&text).ok_or_else(|| format!("{path} is '{text}', no list of cores"))
    }

    /// The names in a folder, sorted.
    pub fn list(&self, path: &str) -> Result<Vec<String>, String> {
        let entries = fs::read_dir(self.path(path)).map_err(|error| unreadable(path, &error))?;
        let mut names: Vec<String> =
            entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        Ok(names)
    }
}

fn unreadable(path: &str, error: &io::Error) -> String {
    // The error's number, and the path if the host is a copy, are left out.
    let text = error.to_string();
    format!("{path}: {}", text.split(" (os error").next().unwrap_or_default())
}

/// A host, its real-time cores and the required priority.
pub struct Host {
    pub tree: Tree,
    online: Result<CoreSet, String>,
    /// Cores that the user named, or that are isolated.
    chosen: Option<CoreSet>,
    /// The highest required priority.
    pub priority: u8,
}

impl Host {
    /// The real-time cores are the named ones, else the isolated ones, else all.
    pub fn new(tree: Tree, named: Option<CoreSet>, priority: u8) -> Self {
        let file = "/sys/devices/system/cpu/online";
        // With an empty set of cores, no check could fail.
        let is_some =
            |cores: CoreSet| (!cores.is_empty()).then_some(cores).ok_or_else(|| format!("{file} is empty"));
        let online = tree.cores(file).and_then(is_some);
        let isolated = isolated(&tree).ok().filter(|cores| !cores.is_empty());
        Host { tree, online, chosen: named.or(isolated), priority }
    }

    pub fn online(&self) -> Result<CoreSet, String> {
        self.online.clone()
    }

    /// The real-time cores.
    pub fn cores(&self) -> Result<CoreSet, String> {
        self.chosen.map_or_else(|| self.online(), Ok)
    }

    /// Whether the real-time cores were named or are isolated.
    pub fn is_chosen(&self) -> bool {
        self.chosen.is_some()
    }

    /// The cores for everything else.
    pub fn others(&self) -> Result<CoreSet, String> {
        let cores = self.cores()?;
        Ok(self.online()?.iter().filter(|core| !cores.contains(*core)).collect())
    }

    /// The major and minor number of the kernel's release, such as 6 and 18.
    pub fn kernel(&self) -> Result<(u32, u32), String> {
        let text = self.tree.read("/proc/sys/kernel/osrelease")?;
        let mut numbers = text.split(|c: char| !c.is_ascii_digit()).map(str::parse);
        match (numbers.next(), numbers.next()) {
            (Some(Ok(major)), Some(Ok(minor))) => Ok((major, minor)),
            _ => Err(format!("/proc/sys/kernel/osrelease is '{text}'")),
        }
    }

    /// Whether the host runs on a hypervisor, according to the processor, the kernel or the firmware.
    pub fn is_virtual(&self) -> Result<bool, String> {
        let info = self.tree.read("/proc/cpuinfo")?;
        let mut flags = info.lines().filter(|line| line.starts_with("flags")).peekable();
        if self.tree.has("/sys/hypervisor/type") {
            return Ok(true);
        }
        if flags.peek().is_some() {
            return Ok(flags.flat_map(str::split_whitespace).any(|flag| flag == "hypervisor"));
        }
        // Only x86 processors have such a flag; for others, the device tree and the firmware's tables are read.
        let has_node = |node: &String| node == "hypervisor" || node.starts_with("fw-cfg@");
        let tree = self.tree.list("/proc/device-tree").unwrap_or_default();
        let compatible = self.tree.read("/proc/device-tree/compatible").unwrap_or_default();
        let told = ["sys_vendor", "product_name"]
            .map(|name| self.tree.read(&format!("/sys/class/dmi/id/{name}")).unwrap_or_default());
        let is_makers = VIRTUAL.iter().any(|maker| told.iter().any(|text| text.starts_with(maker)));
        let is_metal = told[1].ends_with(".metal") || told[1].contains(".metal-");
        Ok(tree.iter().any(has_node) || compatible.contains("dummy-virt") || is_makers && !is_metal)
    }
}

/// Prefixes of the vendor or product names of virtual machines in the firmware's tables (DMI).
const VIRTUAL: [&str; 10] = [
    "QEMU",
    "KVM",
    "OpenStack",
    "Amazon EC2",
    "Google Compute Engine",
    "Virtual Machine",
    "VMware",
    "Xen",
    "Parallels",
    "Apple Virtualization",
];

/// Cores that are isolated from other threads, by isolcpus or by a cpuset partition.
pub fn isolated(tree: &Tree) -> Result<CoreSet, String> {
    let booted = tree.cores("/sys/devices/system/cpu/isolated")?;
    let partitions = tree.cores("/sys/fs/cgroup/cpuset.cpus.isolated").unwrap_or_default();
    Ok(booted.iter().chain(partitions.iter()).collect())
}
