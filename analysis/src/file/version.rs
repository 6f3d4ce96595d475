// SPDX-License-Identifier: MIT OR Apache-2.0
//! The version of the file's schema: it changes when a key is removed or changes its meaning, not when one is added.
use super::reader::Section;

/// The version that is read. A file without the key `version` is of version 1.
pub const CURRENT: i64 = 1;

/// Why a file of this version is not read where another one is current, with the fix; `None` for the current one.
pub fn refusal(version: i64, current: i64) -> Option<String> {
    let fix = match version {
        _ if version == current => return None,
        ..1 => "versions begin with 1",
        _ if version < current => "run `taut check --migrate` on it",
        _ => "use the newer Tautline that it was written for, or write it anew with `taut init`",
    };
    Some(format!("the file is of version {version}, and this Tautline reads version {current}: {fix}"))
}

/// Adds a problem if the file is not of the version that is read.
pub(super) fn check(root: &mut Section<'_>) {
    if let Some(version) = root.integer("version")
        && let Some(refusal) = refusal(version.value, CURRENT)
    {
        root.problem(version.at).add(refusal);
    }
}

#[cfg(test)]
mod tests {
    use super::refusal;

    #[test]
    fn each_version_but_the_current_one_is_named_with_its_fix() {
        assert_eq!(refusal(2, 2), None);
        let said = |version| refusal(version, 2).unwrap();
        let of = |version| format!("the file is of version {version}, and this Tautline reads version 2: ");
        assert_eq!(said(1), of(1) + "run `taut check --migrate` on it");
        assert!(said(3).starts_with(&(of(3) + "use the newer Tautline")));
        assert_eq!(said(0), of(0) + "versions begin with 1");
    }
}
