// SPDX-License-Identifier: MIT OR Apache-2.0
//! The picture as tables: on a terminal, or printed once.

use super::picture::{CallbackRow, Order, Picture};
use ratatui::Frame;
use ratatui::layout::{Alignment, Constraint, Layout};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::Text;
use ratatui::widgets::{Block, Cell, Paragraph, Row, Table, TableState};
use std::io::{self, Write};
use taut_cli::table::{self, write_table};

/// The state of the display.
#[derive(Default)]
pub struct View {
    pub order: Order,
    pub filter: String,
    /// The filter is being typed.
    pub is_typing: bool,
    pub is_frozen: bool,
    /// Callbacks or topics are scrolled.
    pub is_on_topics: bool,
    pub callbacks: TableState,
    pub topics: TableState,
}

const CALLBACKS: [&str; 13] = [
    "callback",
    "program",
    "Hz",
    "p50 ms",
    "p99 ms",
    "max ms",
    "bound",
    "used max",
    "budget",
    "queue",
    "missed",
    "lost",
    "prio@core",
];
const TOPICS: [&str; 6] = ["topic", "pub", "sub", "Hz", "bytes/s", "lost"];
const CORES: [&str; 4] = ["core", "load %", "steal %", "throttled"];

fn ms(value: Option<f64>) -> String {
    value.map_or("-".into(), |ms| format!("{ms:.3}"))
}

fn callback(row: &CallbackRow) -> Vec<String> {
    let place = match (row.priority, row.core) {
        (Some(priority), Some(core)) => format!("{}@{core}", table::priority(priority)),
        (Some(priority), None) => table::priority(priority),
        (None, _) => "-".into(),
    };
    let room = row.capacity.map_or(row.depth.to_string(), |capacity| capacity.to_string());
    vec![
        row.name.clone(),
        format!("{} {}", row.program, row.pid),
        format!("{:.1}", row.releases_hz),
        ms(row.response_p50_ms),
        ms(row.response_p99_ms),
        ms(row.response_max_ms),
        ms(row.bound_ms),
        ms(row.execution_max_ms),
        ms(row.budget_ms),
        if row.depth == 0 { "-".into() } else { format!("{}/{room}", row.queue_max) },
        (row.missed + row.overruns).to_string(),
        row.lost.to_string(),
        place,
    ]
}

/// All rows of the three tables, each with whether it is free of violations.
type Rows = Vec<(bool, Vec<String>)>;

fn rows(picture: &Picture) -> [Rows; 3] {
    let callbacks = picture.callbacks.iter().map(|row| (!row.is_bad(), callback(row))).collect();
    let topic = |row: &super::picture::TopicRow| {
        let number = |value: Option<f64>| value.map_or("-".into(), |value| format!("{value:.1}"));
        let bytes = row.bytes_per_s.map_or("-".into(), |bytes| format!("{bytes:.0}"));
        let (publishers, subscriptions) = (row.publishers.to_string(), row.subscriptions.to_string());
        let lost = row.lost.map_or("-".into(), |lost| lost.to_string());
        (
            row.lost.is_none_or(|lost| lost == 0),
            vec![row.name.clone(), publishers, subscriptions, number(row.rate_hz), bytes, lost],
        )
    };
    let core = |row: &super::picture::CoreRow| {
        let throttled = row.throttled.map_or("-".into(), |count| count.to_string());
        let cells = vec![
            row.core.to_string(),
            format!("{:.0}", row.load_percent),
            format!("{:.1}", row.steal_percent),
            throttled,
        ];
        (row.steal_percent < 5.0, cells)
    };
    [callbacks, picture.topics.iter().map(topic).collect(), picture.cores.iter().map(core).collect()]
}

/// Prints the tables once.
pub fn print(picture: &Picture, out: &mut impl Write) -> io::Result<()> {
    let [callbacks, topics, cores] = rows(picture);
    write_table(&CALLBACKS, 2, callbacks, out)?;
    writeln!(out)?;
    write_table(&TOPICS, 1, topics, out)?;
    writeln!(out)?;
    write_table(&CORES, 1, cores, out)
}

fn table(
    title: String,
    head: &[&'static str],
    left: usize,
    rows: &Rows,
    widest: u16,
    is_active: bool,
) -> Table<'static> {
    let cell = |text: &str, column: usize| {
        let alignment = if column < left { Alignment::Left } else { Alignment::Right };
        Cell::from(Text::from(text.to_owned()).alignment(alignment))
    };
    let line = |cells: &[String]| {
        Row::new(cells.iter().enumerate().map(|(column, text)| cell(text, column)).collect::<Vec<_>>())
    };
    let body: Vec<_> = rows
        .iter()
        .map(|(is_good, cells)| {
            line(cells).style(if *is_good { Style::new() } else { Style::new().fg(Color::Red) })
        })
        .collect();
    let widths = head.iter().enumerate().map(|(column, name)| {
        let longest =
            rows.iter().filter_map(|(_, cells)| cells.get(column)).map(|cell| cell.chars().count()).max();
        let wanted = u16::try_from(longest.unwrap_or(0).max(name.len())).unwrap_or(u16::MAX);
        Constraint::Length(if column < left { wanted.min(widest) } else { wanted })
    });
    let names: Vec<String> = head.iter().map(|name| (*name).to_owned()).collect();
    let title = if is_active { format!("> {title}") } else { title };
    Table::new(body, widths.collect::<Vec<_>>())
        .header(line(&names).style(Style::new().add_modifier(Modifier::BOLD)))
        .row_highlight_style(Style::new().add_modifier(Modifier::REVERSED))
        .block(Block::new().title(title))
}

/// Draws the tables on the terminal.
pub fn draw(frame: &mut Frame<'_>, picture: &Picture, view: &mut View) {
    let [callbacks, topics, cores] = rows(picture);
    let height = |rows: &Rows| u16::try_from(rows.len()).unwrap_or(u16::MAX).saturating_add(2);
    let of_cores = height(&cores).min(frame.area().height / 4);
    let [head, upper, middle, lower, foot] = Layout::vertical([
        Constraint::Length(1),
        Constraint::Fill(1),
        Constraint::Fill(1),
        Constraint::Length(of_cores),
        Constraint::Length(1),
    ])
    .areas(frame.area());
    let frozen = if view.is_frozen { ", frozen" } else { "" };
    let said = format!("taut top: domain {}, {} processes{frozen}", picture.domain, picture.processes());
    frame.render_widget(Paragraph::new(said).style(Style::new().add_modifier(Modifier::BOLD)), head);
    let widest = (frame.area().width / 4).max(12);
    let title = |what: &str, rows: &Rows| format!("{} {what}", rows.len());
    let upper_table =
        table(title("callbacks", &callbacks), &CALLBACKS, 2, &callbacks, widest, !view.is_on_topics);
    frame.render_stateful_widget(upper_table, upper, &mut view.callbacks);
    let middle_table = table(title("topics", &topics), &TOPICS, 1, &topics, 2 * widest, view.is_on_topics);
    frame.render_stateful_widget(middle_table, middle, &mut view.topics);
    frame.render_widget(table(title("cores", &cores), &CORES, 1, &cores, widest, false), lower);
    let keys = match view.is_typing {
        true => format!("filter: {}_", view.filter),
        false => format!(
            "q quit  s sort ({:?})  / filter{}  space freeze  tab other table  arrows scroll",
            view.order,
            if view.filter.is_empty() { String::new() } else { format!(" ({})", view.filter) }
        ),
    };
    frame.render_widget(Paragraph::new(keys), foot);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::picture::{CoreRow, TopicRow};
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;

    fn picture() -> Picture {
        let callback = CallbackRow {
            name: "detect".into(),
            program: "robot".into(),
            pid: 42,
            priority: Some(40),
            core: Some(1),
            jobs: 1000,
            releases_hz: 99.96,
            response_p50_ms: Some(1.0),
            response_p99_ms: Some(2.0),
            response_max_ms: Some(3.5),
            bound_ms: Some(3.0),
            execution_max_ms: Some(1.5),
            budget_ms: None,
            overruns: 0,
            missed: 0,
            queue_max: 1,
            capacity: Some(2),
            depth: 10,
            lost: 0,
        };
        let topic = TopicRow {
            name: "/image".into(),
            type_name: "a/msg/B".into(),
            publishers: 1,
            subscriptions: 2,
            rate_hz: Some(100.0),
            bytes_per_s: None,
            lost: Some(3),
        };
        let core = CoreRow { core: 0, load_percent: 25.0, steal_percent: 0.5, throttled: None };
        Picture { domain: 7, seconds: 1.0, callbacks: vec![callback], topics: vec![topic], cores: vec![core] }
    }

    fn drawn(width: u16, height: u16, view: &mut View) -> String {
        let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
        terminal.draw(|frame| draw(frame, &picture(), view)).unwrap();
        terminal.backend().to_string()
    }

    #[test]
    fn a_screen_shows_callbacks_topics_and_cores() {
        let screen = drawn(140, 20, &mut View::default());
        for part in [
            "taut top: domain 7, 1 processes",
            "> 1 callbacks",
            "detect   robot 42 100.0  1.000  2.000  3.500 3.000    1.500      -   1/2      0    0      40@1",
            "/image   1   2 100.0       -    3",
            "1 cores",
            "q quit  s sort (Name)",
        ] {
            assert!(screen.contains(part), "{part}: {screen}");
        }
    }

    /// Draws on terminals of any size.
    #[test]
    fn any_size_is_drawn() {
        for (width, height) in [(1, 1), (3, 2), (20, 5), (80, 24), (400, 3)] {
            let mut view = View { filter: "x".into(), is_typing: true, ..View::default() };
            drawn(width, height, &mut view);
        }
    }

    #[test]
    fn it_can_be_printed() {
        let mut out = Vec::new();
        print(&picture(), &mut out).unwrap();
        let text = String::from_utf8(out).unwrap();
        assert!(text.contains("detect") && text.contains("/image") && text.contains("steal %"), "{text}");
    }
}
