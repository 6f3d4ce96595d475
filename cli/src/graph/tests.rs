// SPDX-License-Identifier: MIT OR Apache-2.0
//! One made-up domain in all formats; names that mean something in a format; pictures of any graph.

use super::Format;
use super::layout::{Link, Size, lay_out};
use super::picture::{Bound, Chain, Edge, EdgeKind, Mismatch, Node, Picture, Rate, Topic, TopicKind};
use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::Path;

const RELIABLE: &str = "RELIABLE, VOLATILE, KEEP_LAST 10";
const BEST_EFFORT: &str = "BEST_EFFORT, VOLATILE, KEEP_LAST 5";

fn node(name: &str, pid: u32) -> Node {
    Node { name: Some(name.into()), pid: Some(pid), place: None }
}

fn topic(kind: TopicKind, name: &str, type_name: &str, rate: Rate) -> Topic {
    Topic { kind, name: name.into(), types: vec![type_name.into()], rate }
}

fn edge(kind: EdgeKind, node: usize, topic: usize, qos: &str) -> Edge {
    let (count, rate, problem, bound) = (1, Rate::None, None, None);
    Edge { kind, node, topic, count, qos: qos.into(), rate, problem, bound }
}

fn bound(callback: &str, response_ns: Option<u64>, met: bool) -> Option<Bound> {
    Some(Bound { callbacks: vec![callback.into()], response_ns, deadline_ns: 1_000_000, met })
}

fn made_up() -> Picture {
    use EdgeKind::{Asks, Publishes, Serves, Subscribes};
    use TopicKind::{Action, Service, Topic};
    let viewer = Node { name: Some("/viewer".into()), pid: None, place: Some("robot2".into()) };
    let nodes = vec![
        node("/camera", 100),
        node("/detect", 101),
        node("/steer", 102),
        node("/steer", 103),
        viewer,
        Node { name: None, pid: Some(104), place: None },
    ];
    let topics = vec![
        topic(Topic, "/cmd_vel", "geometry_msgs/msg/Twist", Rate::Hz(50.0)),
        topic(Topic, "/image", "sensor_msgs/msg/Image", Rate::Hz(29.97)),
        topic(Topic, "/objects", "vision_msgs/msg/Detection2DArray", Rate::Unknown),
        topic(Service, "/camera/start", "std_srvs/srv/Trigger", Rate::None),
        topic(Action, "/steer/turn", "a_msgs/action/Turn", Rate::None),
    ];
    let edges = vec![
        edge(Publishes, 2, 0, RELIABLE),
        Edge { count: 2, ..edge(Publishes, 3, 0, RELIABLE) },
        edge(Subscribes, 5, 0, RELIABLE),
        edge(Publishes, 0, 1, BEST_EFFORT),
        Edge { bound: bound("detect", Some(350_000), true), ..edge(Subscribes, 1, 1, BEST_EFFORT) },
        Edge { problem: Some("QoS: reliability".into()), ..edge(Subscribes, 4, 1, RELIABLE) },
        edge(Publishes, 1, 2, RELIABLE),
        edge(Publishes, 4, 2, RELIABLE),
        Edge { bound: bound("steer", None, false), ..edge(Subscribes, 2, 2, RELIABLE) },
        Edge { bound: bound("steer", Some(1_200_000), false), ..edge(Subscribes, 3, 2, RELIABLE) },
        edge(Asks, 1, 3, ""),
        edge(Serves, 0, 3, ""),
        edge(Asks, 1, 4, ""),
        edge(Serves, 2, 4, ""),
    ];
    let mismatch = Mismatch {
        topic: "/image".into(),
        publisher: "/camera".into(),
        subscription: "/viewer".into(),
        reason: "the offered reliability does not meet the requested one".into(),
    };
    let chain =
        |name: &str, latency_ns, met| Chain { name: name.into(), latency_ns, deadline_ns: 5_000_000, met };
    Picture {
        domain: 7,
        seconds: Some(1.0),
        nodes,
        topics,
        edges,
        mismatches: vec![mismatch],
        chains: vec![chain("look_and_steer", Some(4_200_000), true), chain("look", None, false)],
        left_out: 2,
    }
}

#[test]
fn all_formats_are_as_they_were() {
    let picture = made_up();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
    for (name, format) in [
        ("graph.txt", Format::Text),
        ("graph.svg", Format::Svg),
        ("graph.dot", Format::Dot),
        ("graph.mmd", Format::Mermaid),
        ("graph.json", Format::Json),
    ] {
        let (path, written) = (folder.join(name), crate::print::painted(&format.write(&picture), true));
        // TAUT_GOLDEN=1 writes them anew, for who has looked at them.
        if std::env::var_os("TAUT_GOLDEN").is_some() {
            std::fs::write(&path, &written).unwrap();
        }
        let golden = std::fs::read_to_string(&path).unwrap();
        if format == Format::Json {
            // The order of names in an object means nothing.
            let [written, golden] =
                [written, golden].map(|text| serde_json::from_str::<serde_json::Value>(&text).unwrap());
            assert_eq!(written, golden);
        } else {
            assert_eq!(written, golden, "{name}");
        }
    }
}

#[test]
fn names_that_mean_something_in_a_format_are_escaped() {
    let hostile = "/a\"b\\N<script>&amp;]-->;{}#`\u{1b}[31m\n\u{202e}é漢%%end";
    let mut picture = made_up();
    picture.nodes[0].name = Some(hostile.into());
    picture.topics[1] = topic(TopicKind::Topic, hostile, hostile, Rate::Hz(1.0));
    picture.edges[5].problem = Some(hostile.into());
    picture.mismatches[0].topic = hostile.into();

    let all = [Format::Svg.write(&picture), Format::Dot.write(&picture), Format::Mermaid.write(&picture)];
    for written in &all {
        assert!(!written.contains(['\u{1b}', '\u{202e}']), "{written}");
        assert!(written.contains("é漢"));
    }
    let [svg, dot, mermaid] = all;
    assert!(svg.contains("/a&quot;b\\N&lt;script&gt;&amp;amp;]--&gt;"), "{svg}");
    assert!(dot.contains("/a\\\"b\\\\N<script>&amp;amp;]-->"), "{dot}");
    assert!(mermaid.contains("/a#34;b#92;N#60;script#62;#38;amp#59;]--#62;"), "{mermaid}");
    // One line each, whatever is in them.
    assert_eq!(dot.lines().count(), Format::Dot.write(&made_up()).lines().count());
    assert_eq!(mermaid.lines().count(), Format::Mermaid.write(&made_up()).lines().count());
    let text = Format::Text.write(&picture);
    assert_eq!(text.lines().count(), Format::Text.write(&made_up()).lines().count());
    assert!(!crate::print::painted(&text, false).contains("[31m\n"), "{text}");
}

/// Xorshift.
struct Dice(u64);

impl Dice {
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % n as u64) as usize
    }

    fn picture(&mut self, nodes: usize, topics: usize) -> Picture {
        let all = (0..nodes).map(|index| node(&format!("/robot/node_{index}"), index as u32));
        let mut picture = Picture { nodes: all.collect(), ..Picture::default() };
        for index in 0..topics {
            picture.topics.push(topic(
                TopicKind::Topic,
                &format!("/topic_{index}"),
                "a/msg/B",
                Rate::Hz(10.0),
            ));
            for _ in 0..if nodes == 0 { 0 } else { self.below(5) } {
                let kind = if self.below(2) == 0 { EdgeKind::Publishes } else { EdgeKind::Subscribes };
                let mut edge = edge(kind, self.below(nodes), index, RELIABLE);
                edge.problem = (self.below(9) == 0).then(|| "QoS: reliability".into());
                picture.edges.push(edge);
            }
        }
        picture
    }
}

#[test]
fn any_graph_is_drawn() {
    let seed = std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap().as_nanos() as u64 | 1;
    println!("seed {seed}");
    let mut dice = Dice(seed);
    let mut sizes = vec![(0, 0), (1, 0), (0, 1), (1, 1), (1, 9), (300, 1000)];
    sizes.extend((0..60).map(|_| (dice.below(20), dice.below(30))));
    for (nodes, topics) in sizes {
        let picture = dice.picture(nodes, topics);
        let once = Format::Svg.write(&picture);
        assert_eq!(once, Format::Svg.write(&picture), "the same each time");
        assert!(!once.contains("NaN") && !once.contains("inf"));
        assert_eq!(once.matches("marker-end").count(), picture.edges.len());
        for written in
            [Format::Text.write(&picture), Format::Dot.write(&picture), Format::Mermaid.write(&picture)]
        {
            assert!(!written.is_empty());
        }
    }
}

#[test]
fn boxes_and_texts_do_not_overlap() {
    let seed = std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap().as_nanos() as u64 | 1;
    println!("seed {seed}");
    let mut dice = Dice(seed);
    for _ in 0..100 {
        let n = 1 + dice.below(30);
        let mut size = |least: usize| Size {
            width: (least + dice.below(200)) as f64,
            height: (least + dice.below(40)) as f64,
        };
        let boxes: Vec<Size> = (0..n).map(|_| size(20)).collect();
        let mut links = Vec::new();
        for _ in 0..dice.below(60) {
            let label = (dice.below(3) == 0).then_some(Size { width: 80.0, height: 16.0 });
            // Also from a box to itself, and twice the same.
            links.push(Link {
                from: dice.below(n),
                to: dice.below(n),
                weight: 1 + dice.below(3) as i64,
                label,
            });
        }
        let layout = lay_out(&boxes, &links);
        let labels = links.iter().zip(&layout.labels);
        let labels = labels.filter_map(|(link, at)| Some(((*at)?, link.label?)));
        let all: Vec<_> = layout.boxes.iter().copied().chain(labels).collect();
        for (index, (at, size)) in all.iter().enumerate() {
            let inside =
                |at: f64, size: f64, whole: f64| at - size / 2.0 > -0.01 && at + size / 2.0 < whole + 0.01;
            assert!(
                inside(at.0, size.width, layout.size.width) && inside(at.1, size.height, layout.size.height)
            );
            for (other, other_size) in &all[..index] {
                let apart = |one: f64, other: f64, sizes: f64| (one - other).abs() >= sizes / 2.0 - 0.01;
                assert!(
                    apart(at.0, other.0, size.width + other_size.width)
                        || apart(at.1, other.1, size.height + other_size.height),
                    "{at:?} {size:?}, {other:?} {other_size:?}"
                );
            }
        }
        for ((link, line), label) in links.iter().zip(&layout.lines).zip(&layout.labels) {
            assert_eq!(line.is_empty(), link.from == link.to);
            assert_eq!(label.is_some(), link.label.is_some() && link.from != link.to);
        }
    }
}

#[test]
fn feedback_goes_back() {
    // a -> b -> c -> a: one link is turned round, and drawn from right to left.
    let boxes = [Size { width: 50.0, height: 20.0 }; 3];
    let links: Vec<Link> =
        [(0, 1), (1, 2), (2, 0)].map(|(from, to)| Link { from, to, weight: 1, label: None }).to_vec();
    let layout = lay_out(&boxes, &links);
    let xs: BTreeSet<i64> = layout.boxes.iter().map(|((x, _), _)| *x as i64).collect();
    assert_eq!(xs.len(), 3);
    let back = layout.lines.iter().filter(|line| line[0].0 > line[line.len() - 1].0).count();
    assert_eq!(back, 1);
}

#[test]
fn a_caption_says_what_there_is() {
    let mut all = String::new();
    for (is_good, line) in made_up().caption() {
        writeln!(all, "{} {line}", u8::from(is_good)).unwrap();
    }
    let expected = "1 Domain 7: 5 nodes, 3 topics, 1 service, 1 action; rates of 1.0 s; 2 left out, --all shows them\n\
                    1 Chain look_and_steer: latency ≤ 4.200 ms\n\
                    0 Chain look: no bound\n\
                    0 /image: no message gets from /camera to /viewer: the offered reliability does not meet the requested one\n";
    assert_eq!(all, expected);
}
