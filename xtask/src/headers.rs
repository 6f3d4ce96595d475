// SPDX-License-Identifier: MIT OR Apache-2.0
//! rmw_tautline built with the headers of distributions that PyPI does not have. They are made of those that it has: what came later is
//! hidden, or what came since is added. What is built starts nowhere, which is tested, and is replaced by the next build.

use crate::build::Build;
use crate::r2r::Environment;
use crate::ros::{self, Distribution};
use crate::steps::{Steps, announce};
use crate::with_ros::{RMW, with_libraries};
use crate::{files, lints, machine, word};
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;

const PACKAGES: &str = "fastcdr rcutils rmw rosidl_dynamic_typesupport rosidl_runtime_c rosidl_typesupport_fastrtps_cpp \
    rosidl_typesupport_interface rosidl_typesupport_introspection_c";

/// A distribution by its differences from one that PyPI has.
struct Other {
    name: &'static str,
    from: Distribution,
    /// Names that it does not have.
    hidden: &'static str,
    /// Text that differs.
    changed: &'static [(&'static str, &'static str)],
    /// Files of its own, in `include`.
    files: &'static [(&'static str, &'static str)],
}

const OTHERS: [Other; 2] = [
    // rmw 6.1, rosidl 3.1, Fast CDR 1.0.
    Other {
        name: "humble",
        from: Distribution::Jazzy,
        hidden: "RMW_EVENT_PUBLICATION_MATCHED RMW_EVENT_PUBLISHER_INCOMPATIBLE_TYPE \
            RMW_EVENT_SUBSCRIPTION_INCOMPATIBLE_TYPE RMW_EVENT_SUBSCRIPTION_MATCHED \
            RMW_QOS_POLICY_DURABILITY_BEST_AVAILABLE RMW_QOS_POLICY_LIVELINESS_BEST_AVAILABLE \
            RMW_QOS_POLICY_RELIABILITY_BEST_AVAILABLE event_members_ event_typesupport \
            get_type_description_func get_type_hash_func has_any_key_member_ is_key_ request_typesupport \
            response_typesupport rmw_discovery_options_copy rmw_discovery_options_fini \
            rmw_discovery_options_t rmw_get_zero_initialized_discovery_options \
            rmw_incompatible_type_status_t rmw_matched_status_t \
            rmw_topic_endpoint_info_set_topic_type_hash rosidl_type_hash_t topic_type_hash",
        changed: &[
            ("rmw_discovery_options_t discovery_options;", ""),
            ("RMW_GID_STORAGE_SIZE 16u", "RMW_GID_STORAGE_SIZE 24u"),
            ("uint8_t writer_guid[RMW_GID_STORAGE_SIZE]", "int8_t writer_guid[16]"),
        ],
        files: &[
            (
                "fastcdr/fastcdr/Cdr.h",
                "#pragma once
                #include <cstddef>
                namespace eprosima { namespace fastcdr {
                struct FastBuffer { FastBuffer(char *, size_t); };
                struct Cdr {
                    enum Endianness { BIG_ENDIANNESS, LITTLE_ENDIANNESS };
                    enum CdrType { CORBA_CDR, DDS_CDR };
                    Cdr(FastBuffer &, Endianness, CdrType);
                    size_t getSerializedDataLength() const;
                };
                }}",
            ),
            ("fastcdr/fastcdr/FastBuffer.h", "#include <fastcdr/Cdr.h>"),
            ("fastcdr/fastcdr/config.h", "#define FASTCDR_VERSION_MAJOR 1"),
        ],
    },
    // rmw 7.10 and 7.11, which Rolling has, too.
    Other {
        name: "lyrical",
        from: Distribution::Kilted,
        hidden: "",
        changed: &[
            ("bool is_cft_enabled;", "bool is_cft_enabled; bool is_cft_supported;"),
            (
                "rmw_subscription_content_filter_options_t * content_filter_options;",
                "rmw_subscription_content_filter_options_t * content_filter_options; const char * acceptable_buffer_backends;",
            ),
        ],
        files: &[(
            "rmw/rmw/get_service_endpoint_info.h",
            "#include <rmw/types.h>
            typedef struct { size_t size; void * info_array; } rmw_service_endpoint_info_array_t;
            rmw_service_endpoint_info_array_t rmw_get_zero_initialized_service_endpoint_info_array(void);",
        )],
    },
];

/// Builds and lints with each.
pub fn test(steps: &mut Steps, environment: &Environment) {
    for other in OTHERS {
        let name = format!("rmw on headers of {}", other.name);
        let prefix = machine::target_dir().join("headers").join(other.name);
        if !steps.step(&format!("{name}: made"), || make(&other, &prefix)) {
            continue;
        }
        let built = lints::build_with(steps, &name, &format!("{RMW} --lib"), |command| {
            with_libraries(environment, command)
                .env("AMENT_PREFIX_PATH", &prefix)
                .env("ROS_DISTRO", other.name)
        });
        // The loader itself refuses what needs another Fast CDR.
        if built && other.from == ros::chosen() {
            refused(steps, other.name, other.from);
        }
    }
}

/// The library that was built last does not start in another distribution, and says so.
pub fn refused(steps: &mut Steps, built: &str, by: Distribution) {
    steps.step(&format!("rmw: {} refuses {built}'s", word(by)), || {
        let venv = ros::folder_of(by).join("venv");
        let mut node = Command::new(venv.join("bin/python"));
        node.args(["-c", "import rclpy; rclpy.init()"]).env_remove("ROS_DISTRO");
        node.env("LD_LIBRARY_PATH", venv.join("lib")).env_remove("AMENT_PREFIX_PATH");
        node.env("RMW_IMPLEMENTATION", "rmw_tautline");
        // The library's rpath is that of its build: the librmw comes first, as it does where there is one distribution.
        let [librmw, library] =
            [venv.join("lib/librmw.so"), Build::Tests.folder().join("librmw_tautline.so")];
        node.env("LD_PRELOAD", format!("{} {}", librmw.display(), library.display()));
        announce(&node);
        let output = node.output().map_err(|error| format!("Python: {error}"))?;
        let said = String::from_utf8_lossy(&output.stderr);
        let expected =
            format!("built for ROS 2 {built}, and the librmw that is loaded is of {}: build it", word(by));
        if !output.status.success() && said.contains(&expected) { Ok(()) } else { Err(said.into_owned()) }
    });
}

fn make(other: &Other, prefix: &Path) -> Result<(), String> {
    let say = files::at(prefix);
    let from = ros::folder_of(other.from);
    if !from.join("venv/include").is_dir() {
        return Err(format!("no {}: run `cargo xtask ros --distro {}`", from.display(), word(other.from)));
    }
    files::make_empty(prefix).map_err(say)?;
    let (include, mut texts) = (from.join("venv/include"), Vec::new());
    for package in PACKAGES.split(' ') {
        for path in files::below(&include.join(package)).map_err(files::at(&include))? {
            let name = path.strip_prefix(&include).unwrap_or(&path).display().to_string();
            texts.push((name, files::read(&path)?));
        }
    }
    for (path, text) in other.files {
        texts.retain(|(there, _)| there != path);
        texts.push(((*path).to_owned(), (*text).to_owned()));
    }
    for (old, new) in other.changed {
        replace(&mut texts, old, new, |_| true)?;
    }
    for hidden in other.hidden.split_whitespace() {
        let is_whole = |around: [Option<char>; 2]| {
            around.iter().flatten().all(|beside| !beside.is_alphanumeric() && *beside != '_')
        };
        replace(&mut texts, hidden, &format!("hidden_{hidden}"), is_whole)?;
    }
    for (path, text) in texts {
        files::write(&prefix.join("include").join(path), text)?;
    }
    // Of the one that it is made from: functions that it lacks are not looked for.
    symlink(from.join("prefix/lib"), prefix.join("lib")).map_err(say)
}

/// Replaces what is between such characters, in all texts; in none is an error.
fn replace(
    texts: &mut [(String, String)],
    old: &str,
    new: &str,
    is_meant: impl Fn([Option<char>; 2]) -> bool,
) -> Result<(), String> {
    let mut count = 0;
    for (_, text) in texts {
        let mut done = String::with_capacity(text.len());
        let mut end = 0;
        for (at, _) in text.match_indices(old) {
            let after = at + old.len();
            let is_meant = is_meant([text[..at].chars().next_back(), text[after..].chars().next()]);
            done += &text[end..at];
            done += if is_meant { new } else { old };
            count += usize::from(is_meant);
            end = after;
        }
        done += &text[end..];
        *text = done;
    }
    if count == 0 { Err(format!("the headers do not have `{old}`, which differs")) } else { Ok(()) }
}
