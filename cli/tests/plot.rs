// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut bag plot`: what is in the bag is in the picture and in the JSON; what cannot be drawn is said.

#[path = "support/schemas.rs"]
mod schemas;

use schemas::{Checked, ended};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;
use std::process::Command;
use tautline_bag::{Definition, Options, Stamp, Topic, Writer};
use tempfile::TempDir;

const START_NS: u64 = 1_763_918_546_000_000_000;
const MS: u64 = 1_000_000;
const DEFINITION: &str = "float64 value\nbool on\nint64 big\nstring name\nfloat32[] list\ndemo_msgs/Part part\n\
    ================================================================================\nMSG: demo_msgs/Part\nuint8 x\n";

struct Place(TempDir);

impl Place {
    /// A message each millisecond: a wave with a spike at 1.234 s, no number from 2 s to 3 s.
    fn new(messages: u64) -> Self {
        let place = Place(tempfile::tempdir().unwrap());
        let mut writer = Writer::create(&place.path("bag"), Options::default(), BTreeMap::new()).unwrap();
        let topic = |name: &str| Topic {
            name: name.to_owned(),
            type_name: "demo_msgs/msg/Sample".to_owned(),
            definition: Some(Definition::ros2msg(DEFINITION)),
            ..Topic::default()
        };
        let ids = [topic("/wave"), topic("/one")].map(|topic| writer.add_topic(topic).unwrap());
        for n in 0..messages {
            let log_ns = START_NS + n * MS;
            let stamp = Stamp { sequence: 0, log_ns, publish_ns: log_ns };
            let value = match n {
                1234 => 1000.0,
                2000..3000 => f64::NAN,
                _ => (n as f64 / 500.0).sin(),
            };
            writer.write(ids[0], stamp, &sample(value, n)).unwrap();
            if n % 1000 == 999 {
                writer.flush().unwrap();
            }
            if n == 0 {
                writer.write(ids[1], stamp, &sample(7.0, 1)).unwrap();
            }
        }
        writer.finish(BTreeMap::new()).unwrap();
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn plot(&self, args: &[&str]) -> (i32, String, String) {
        let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
        command.args(["bag", "plot", "bag"]).args(args).current_dir(self.0.path()).env_remove("RUST_LOG");
        ended(command.checked())
    }

    fn svg(&self, args: &[&str]) -> String {
        let (code, svg, errors) = self.plot(args);
        assert!(code == 0 && errors.is_empty(), "{errors}");
        svg
    }
}

/// As little-endian CDR.
fn sample(value: f64, n: u64) -> Vec<u8> {
    let mut cdr = vec![0, 1, 0, 0];
    cdr.extend(value.to_le_bytes());
    cdr.extend([u8::from(n % 2 == 1), 0, 0, 0, 0, 0, 0, 0]);
    cdr.extend((i64::MAX - n as i64).to_le_bytes());
    cdr.extend([2, 0, 0, 0, b'a', 0, 0, 0]);
    // One element more with each message, up to three.
    let len = (n as u32 + 1).min(3);
    cdr.extend(len.to_le_bytes());
    (0..len).for_each(|at| cdr.extend((at as f32).to_le_bytes()));
    cdr.push(n as u8);
    cdr
}

/// The points of each line of the first field.
fn lines(svg: &str) -> Vec<Vec<(i32, i32)>> {
    let polylines = svg.split("<polyline ").skip(1).filter(|element| element.contains("stroke=\"#0072B2\""));
    let points = polylines.map(|element| {
        let points = element.split("points=\"").nth(1).unwrap().split('"').next().unwrap();
        points.split_whitespace().map(|point| {
            let (x, y) = point.split_once(',').unwrap();
            (x.parse().unwrap(), y.parse().unwrap())
        })
    });
    points.map(Iterator::collect).collect()
}

#[test]
fn spikes_and_gaps_are_drawn() {
    let place = Place::new(10_000);
    let svg = place.svg(&["/wave.value", "--width", "500"]);
    let lines = lines(&svg);
    // Before the gap and behind it, each no more than four points for a pixel.
    assert_eq!(lines.len(), 2, "{svg}");
    assert!(lines.iter().flatten().count() < 4 * 500);
    let x = |at: usize| lines[at].iter().map(|(x, _)| *x);
    let (left, right) = (x(0).min().unwrap(), x(1).max().unwrap());
    let of = |seconds: f64| left + (f64::from(right - left) * seconds / 9.999).round() as i32;
    assert!((x(0).max().unwrap() - of(2.0)).abs() <= 1 && (x(1).min().unwrap() - of(3.0)).abs() <= 1);
    let (highest, low) = (lines[0].iter().min_by_key(|(_, y)| *y).unwrap(), lines[0][0].1);
    assert!((highest.0 - of(1.234)).abs() <= 1 && low - highest.1 > 200, "{highest:?} {low}");
    for words in ["bag", "/wave.value (1000 of 10000 are gaps)", "2025-11-23 17:22:26 UTC", "in s"] {
        assert!(svg.contains(words), "{words}: {svg}");
    }
    // A part of it, without the spike.
    let part = place.svg(&["/wave.value", "wave.on", "--from", "4s", "--to", "4.5s"]);
    assert!(part.contains("4.50") && part.contains("/wave.on"), "{part}");
    let (code, out, _) = place.plot(&["/wave.value", "-o", "wave.svg", "--width", "500"]);
    assert_eq!((code, &*out), (0, "wave.svg: 10000 messages of 10.0 s\n"));
    assert_eq!(fs::read_to_string(place.path("wave.svg")).unwrap(), svg);
}

#[test]
fn json_has_every_point() {
    let place = Place::new(4);
    let fields = ["/wave.big", "/wave.on", "/wave.list[1]", "/one.part.x"];
    let (code, out, errors) = place.plot(&[&fields[..], &["--json"]].concat());
    assert!(code == 0 && errors.is_empty(), "{errors}");
    let report: Value = serde_json::from_str(&out).unwrap();
    let points = |at: usize| &report["series"][at]["points"];
    let at = |n: u64| START_NS + n * MS;
    assert_eq!(points(0)[1], json!([at(1), i64::MAX - 1]), "{report}");
    assert_eq!(points(1), &json!([[at(0), false], [at(1), true], [at(2), false], [at(3), true]]));
    assert_eq!(points(2), &json!([[at(0), null], [at(1), 1.0], [at(2), 1.0], [at(3), 1.0]]));
    assert_eq!(points(3), &json!([[at(0), 1]]));
    assert_eq!((&report["start_ns"], &report["series"][2]["gaps"]), (&json!(START_NS), &json!(1)));
    assert_eq!(
        (&report["series"][3]["topic"], &report["series"][3]["field"]),
        (&json!("/one"), &json!("part.x"))
    );
}

#[test]
fn what_cannot_be_drawn_is_said() {
    let place = Place::new(2500);
    for (args, code, words) in [
        (&["/wav.value"][..], 1, "there is no topic '/wav' in bag; did you mean /wave? it has /wave, /one"),
        (
            &["/wave.valeu"],
            1,
            "there is no field 'valeu' in /wave, a demo_msgs/msg/Sample; did you mean value? it has value, on, big, name, list, part",
        ),
        (&["/wave.name"], 2, "/wave.name is a string: numbers and bools can be drawn"),
        (&["/wave.list"], 2, "/wave.list is a float32[]: name an element, such as /wave.list[0]"),
        (&["/wave.part"], 2, "/wave.part is a demo_msgs/Part: name a field of it: x"),
        (&["/wave.list[7]"], 1, "/wave.list[7] is no number in any of 2500 messages"),
        (
            &["/wave.value", "--from", "2.1s", "--to", "2.2s"],
            1,
            "/wave.value is no number in any of 101 messages",
        ),
        (&["/wave.value", "--from", "1h"], 2, "there is nothing between: the bag is of 2.5 s"),
        (&["/wave.value", "--from", "2s", "--to", "1s"], 2, "there is nothing between: the bag is of 2.5 s"),
        (&["/one.value", "--from", "1s"], 1, "/one has no message in that time"),
        (&["/wave"], 2, "a topic, a dot and a field"),
        (&["/wave.value", "-o", "wave.png"], 2, "'wave.png': pictures are SVG: name it .svg"),
        (&["/wave.value", "-o", "none/wave.svg"], 2, "'none/wave.svg' cannot be written"),
        (&["/wave.value", "--width", "3"], 2, "3 is not in 320..=16000"),
        (&["/wave.on"; 8], 2, "more than 7 lines cannot be told apart"),
    ] {
        let (ended, out, errors) = place.plot(args);
        assert!(
            ended == code && errors.contains(words) && out.is_empty(),
            "{args:?}: {ended} {out} {errors}"
        );
    }
    // What is cut off is drawn as far as it is whole.
    let file = place.path("bag/bag_0.mcap");
    let whole = fs::read(&file).unwrap();
    fs::write(&file, &whole[..whole.len() * 2 / 3]).unwrap();
    let (code, out, errors) = place.plot(&["/wave.value"]);
    assert!(code == 1 && out.starts_with("<svg") && errors.contains("what is whole was taken"), "{errors}");
}
