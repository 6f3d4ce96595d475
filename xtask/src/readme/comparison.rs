// SPDX-License-Identifier: MIT OR Apache-2.0
//! The README's comparison: some rows and columns of the table that `cargo xtask bench compare` writes into docs/benchmarks.md.

/// The columns, by their headings there.
const COLUMNS: [&str; 6] =
    ["system", "64 B", "1 MiB", "8 MiB", "1 kHz under load, p99 / p99.9", "robot: CPU"];
/// The systems, each in a mode that sleeps until a message arrives; busy polling of those that have it; Fast DDS also as ROS 2 ships it.
const ROWS: [&str; 12] = [
    "floor, futex",
    "tautline, blocking",
    "tautline, direct",
    "tautline, busy-poll",
    "iceoryx2, waitset",
    "iceoryx2, busy-poll",
    "cyclonedds, shared-memory",
    "fastdds, data-sharing",
    "fastdds, default",
    "r2r, typed",
    "zenoh, shm",
    "hiroz, pub-sub",
];

/// The README's table, from the whole one. A system that was not measured has no row.
pub(super) fn excerpt(table: &str) -> Result<String, String> {
    // The first table is the whole comparison, those after it show more of some columns.
    let is_row = |line: &&str| line.starts_with('|');
    let mut rows = table.lines().skip_while(|line| !is_row(line)).take_while(is_row).map(cells);
    let heading = rows.next().ok_or("the comparison has no table")?;
    let place = |name: &&str| heading.iter().position(|cell| cell == name);
    let places: Vec<usize> = COLUMNS.iter().filter_map(place).collect();
    if places.len() != COLUMNS.len() {
        return Err(format!("the comparison's table has not all of the columns {}", COLUMNS.join(", ")));
    }
    let rows: Vec<_> = rows.collect();
    let shown = ROWS.iter().filter_map(|name| rows.iter().find(|row| row.first() == Some(name)));
    let mut text = line(COLUMNS) + "|---|--:|--:|--:|--:|--:|\n";
    for row in shown {
        text += &line(places.iter().map(|place| row.get(*place).copied().unwrap_or("-")));
    }
    Ok(text)
}

fn cells(row: &str) -> Vec<&str> {
    row.trim_matches('|').split('|').map(str::trim).collect()
}

fn line<'a>(cells: impl IntoIterator<Item = &'a str>) -> String {
    let cells: Vec<_> = cells.into_iter().collect();
    format!("| {} |\n", cells.join(" | "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::read;
    use crate::machine;
    use crate::readme::marked;

    #[test]
    fn an_excerpt_has_the_rows_and_columns_that_it_names() {
        let table = "| system | 64 B | 1 MiB | 8 MiB | 1 kHz under load, p99 / p99.9 | robot: CPU | at once |\n|---|--:|\n\
             | zenoh, shm | 1 | 2 | 3 | 4 | 5 | 6 |\n| zenoh, tcp | 0 | 0 | 0 | 0 | 0 | 0 |\n| floor, futex | 7 | 8 | 9 | - | - | - |\n\ntext\n";
        let expected = "| system | 64 B | 1 MiB | 8 MiB | 1 kHz under load, p99 / p99.9 | robot: CPU |\n|---|--:|--:|--:|--:|--:|\n\
             | floor, futex | 7 | 8 | 9 | - | - |\n| zenoh, shm | 1 | 2 | 3 | 4 | 5 |\n";
        assert_eq!(excerpt(table).unwrap(), expected);
        assert!(excerpt("| system | 64 B |\n").unwrap_err().contains("robot: CPU"));
    }

    #[test]
    fn the_readme_compares_by_the_figures_of_the_benchmarks() {
        let root = machine::root();
        let benchmarks = read(&root.join("docs/benchmarks.md")).unwrap();
        let readme = read(&root.join("README.md")).unwrap();
        let whole = &benchmarks[marked(&benchmarks, "compare").unwrap()];
        let shown = &readme[marked(&readme, "comparison").unwrap()];
        assert_eq!(shown.trim(), excerpt(whole).unwrap().trim());
    }
}
