// SPDX-License-Identifier: MIT OR Apache-2.0
//! Events in, actions out; and a simulated network of hosts, for loops and duplicates.

use super::*;
use crate::graph::GraphLimits;
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use tautline_relay::Transit;

const HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";
const ZID: u128 = 0xAA;

fn mirror(zid: u128, filter: Filter) -> Mirror {
    // Each host's domain has the number of its gateway.
    let transit = Transit::to_network(zid as u64, zid as u64, zid, "host");
    Mirror::new(5, zid, Graph::new(5, zid, GraphLimits::default(), transit), filter)
}

fn key(topic: &str) -> TopicKey {
    TopicKey::parse(&format!("5/{topic}/std_msgs::msg::dds_::String_/{HASH}")).unwrap()
}

fn local(gid: u8, kind: EndpointKind, topic: &str) -> LocalEndpoint {
    LocalEndpoint {
        gid: Gid([gid; 16]),
        kind,
        topic: format!("/{topic}"),
        type_id: key(topic).type_id,
        qos: WireQos { depth: 10, ..WireQos::default() },
        node: NodeName::new("/", "n"),
        origin: Origin { tag: gid.into(), ..Origin::default() },
    }
}

fn node(name: NodeName) -> LocalNode {
    LocalNode { name, origin: Origin { tag: 99, ..Origin::default() } }
}

fn publisher(gid: u8, topic: &str) -> LocalEndpoint {
    local(gid, EndpointKind::Publisher, topic)
}

fn subscription(gid: u8, topic: &str) -> LocalEndpoint {
    local(gid, EndpointKind::Subscription, topic)
}

fn late_joining(mut endpoint: LocalEndpoint) -> LocalEndpoint {
    endpoint.qos.durability = Durability::TransientLocal;
    endpoint
}

fn remote(zid: u128, id: u64, kind: &str, topic: &str, qos: &str) -> String {
    format!("@ros2_lv/5/{zid:x}/0/{id}/{kind}/%/%/n/%{topic}/std_msgs::msg::dds_::String_/{HASH}/{qos}")
}

/// Actions as short text: what is compared.
fn said(actions: &[Action]) -> Vec<String> {
    let name = |key: &TopicKey| key.topic.clone();
    let token = |token: &Token| match &token.endpoint {
        None => format!("node {}", token.node.full_name()),
        Some(endpoint) => format!("{:?} {}", endpoint.kind, endpoint.name),
    };
    let one = |action: &Action| match action {
        Action::Declare(t) => format!("declare {}", token(t)),
        Action::Undeclare(t) => format!("undeclare {}", token(t)),
        Action::SayEnded(tag) => format!("say ended {tag}"),
        Action::StartOut(key, qos) => format!("start out {} {:?} {}", name(key), qos.durability, qos.depth),
        Action::OpenWriter(key, writer) => format!("open {} {}", name(key), writer.local_gid.0[0]),
        Action::CloseWriter(key, gid) => format!("close {} {}", name(key), gid.0[0]),
        Action::StopOut(key) => format!("stop out {}", name(key)),
        Action::StartIn(key, qos) => format!("start in {} {:?} {}", name(key), qos.durability, qos.depth),
        Action::StopIn(key) => format!("stop in {}", name(key)),
        Action::PassOver(key) => format!("pass over {}", name(key)),
        Action::Resync => "resync".into(),
    };
    actions.iter().map(one).collect()
}

const NOTHING: [&str; 0] = [];
const QOS: &str = "::,10:,:,:,,";

/// They are announced; no sample goes through them.
#[test]
fn services_and_clients_are_announced() {
    let mut m = mirror(ZID, Filter::default());
    let (service, client) = (local(1, EndpointKind::Service, "add"), local(2, EndpointKind::Client, "add"));
    let began = ["declare node /n", "declare Service /add", "declare Client /add"];
    assert_eq!(said(&m.set_locals(vec![], vec![service.clone(), client.clone()])), began);
    assert_eq!(said(&m.token_up(&remote(1, 1, "SC", "add", "::,10:,:,:,,"))), NOTHING);
    assert_eq!(said(&m.token_up(&remote(1, 2, "SS", "add", "::,10:,:,:,,"))), NOTHING);
    assert_eq!(said(&m.set_locals(vec![], vec![client])), ["undeclare Service /add"]);
    let denied = Filter::new(&[], &["/add".into()]).unwrap();
    assert_eq!(said(&mirror(ZID, denied).set_locals(vec![], vec![service])), NOTHING);
}

#[test]
fn samples_go_out_while_both_ends_exist() {
    let mut m = mirror(ZID, Filter::default());
    assert_eq!(
        said(&m.set_locals(vec![], vec![publisher(1, "x")])),
        ["declare node /n", "declare Publisher /x"]
    );
    assert_eq!(said(&m.set_locals(vec![], vec![publisher(1, "x")])), NOTHING);
    let reader = remote(1, 7, "MS", "x", QOS);
    assert_eq!(said(&m.token_up(&reader)), ["start out /x Volatile 10", "open /x 1"]);
    assert_eq!(said(&m.token_up(&remote(2, 7, "MS", "x", QOS))), NOTHING, "one put serves both");
    assert_eq!(said(&m.token_up(&remote(2, 8, "MP", "x", QOS))), NOTHING, "nobody here listens");
    let two = vec![publisher(1, "x"), publisher(2, "x")];
    assert_eq!(said(&m.set_locals(vec![], two)), ["declare Publisher /x", "open /x 2"]);
    assert_eq!(
        said(&m.set_locals(vec![], vec![publisher(2, "x")])),
        ["close /x 1", "undeclare Publisher /x"]
    );
    assert_eq!(said(&m.token_down(&reader)), NOTHING);
    assert_eq!(said(&m.token_down(&remote(2, 7, "MS", "x", QOS))), ["stop out /x"]);
    assert_eq!(said(&m.close()), ["undeclare Publisher /x", "undeclare node /n"]);
}

#[test]
fn of_a_publisher_that_ended_that_is_said_before_its_token_goes() {
    let mut m = mirror(ZID, Filter::default());
    m.set_locals(vec![], vec![publisher(1, "x"), publisher(2, "x"), subscription(3, "x")]);
    // Its tag is its gid's here, and of what is no publisher nobody says it.
    m.set_ended(&[1, 9]);
    assert_eq!(
        said(&m.set_locals(vec![], vec![])),
        [
            "say ended 1",
            "undeclare Publisher /x",
            "undeclare Publisher /x",
            "undeclare Subscription /x",
            "undeclare node /n"
        ]
    );
    assert_eq!(said(&m.close()), NOTHING);
}

#[test]
fn what_is_kept_is_taken_again_when_a_publisher_is_announced_anew() {
    let mut m = mirror(ZID, Filter::default());
    // Of another host, told here by a bridge; and a gateway next to it that announces it as well.
    let origin = Origin { tag: 7, path: vec![3, 4], ..Origin::default() };
    let far = LocalEndpoint { origin, ..late_joining(publisher(1, "map")) };
    let nearer = |hops: &str| {
        let enclave = format!("%tautline%0000000000000007%0%there{hops}");
        remote(1, 7, "MP", "map", QOS).replace("/%/%/n/", &format!("/{enclave}/%/n/"))
    };
    let depth = RELAYED_DEPTH;
    let began = format!("start out /map TransientLocal {depth}");
    let all = said(&m.set_locals(vec![], vec![far, late_joining(publisher(2, "map"))]));
    assert_eq!(all.iter().filter(|action| **action == began).count(), 1, "{all:?}");
    assert_eq!(said(&m.token_up(&nearer("%0000000000000003"))), NOTHING);
    assert_eq!(said(&m.settle()), ["close /map 1", "undeclare Publisher /map", "undeclare node /n"]);
    assert!(m.take_passed_over().is_some_and(|passed_over| passed_over == HashSet::from([Gid([1; 16])])));
    assert_eq!(said(&m.token_down(&nearer("%0000000000000003"))), NOTHING);
    assert_eq!(said(&m.settle()), ["declare node /n", "declare Publisher /map", &began, "open /map 1"]);
}

#[test]
fn samples_come_in_while_both_ends_exist() {
    let mut m = mirror(ZID, Filter::default());
    let writer = remote(1, 7, "MP", "x", QOS);
    assert_eq!(said(&m.token_up(&writer)), NOTHING);
    let locals = vec![subscription(1, "x"), subscription(2, "x")];
    let began =
        ["declare node /n", "declare Subscription /x", "declare Subscription /x", "start in /x Volatile 1"];
    assert_eq!(said(&m.set_locals(vec![], locals)), began, "once for all subscriptions of the host");
    assert_eq!(said(&m.token_up(&remote(2, 7, "MP", "x", QOS))), NOTHING);
    assert_eq!(said(&m.token_down(&writer)), NOTHING);
    let ended = ["stop in /x", "undeclare Subscription /x", "undeclare Subscription /x", "undeclare node /n"];
    assert_eq!(said(&m.set_locals(vec![], vec![])), ended);
}

#[test]
fn another_type_or_hash_is_another_topic() {
    let mut m = mirror(ZID, Filter::default());
    m.set_locals(vec![], vec![publisher(1, "x"), subscription(2, "x")]);
    let other_hash = remote(1, 7, "MS", "x", QOS).replace("RIHS01_df", "RIHS01_00");
    assert_eq!(said(&m.token_up(&other_hash)), NOTHING);
    assert!(m.mismatches()["/x"].contains("RIHS01_00"));
    assert_eq!(said(&m.token_up(&remote(1, 8, "MP", "x", QOS).replace("String_", "Bool_"))), NOTHING);
    assert!(m.mismatches()["/x"].contains("std_msgs"));

    // Unless there is an end of that type here, too.
    let mut bool = publisher(3, "x");
    bool.type_id.name = "std_msgs/msg/Bool".parse().unwrap();
    m.set_locals(vec![], vec![publisher(1, "x"), bool]);
    m.token_down(&other_hash);
    assert_eq!(m.mismatches(), BTreeMap::new());
}

#[test]
fn transient_local_samples_are_kept_before_anybody_listens() {
    let mut m = mirror(ZID, Filter::default());
    let began =
        ["declare node /n", "declare Publisher /map", "start out /map TransientLocal 10", "open /map 1"];
    assert_eq!(said(&m.set_locals(vec![], vec![late_joining(publisher(1, "map"))])), began);
    assert_eq!(said(&m.token_up(&remote(1, 7, "MS", "map", ":1:,1:,:,:,,"))), NOTHING);
    // A volatile one that also publishes changes nothing, nor that it alone is left.
    let both = vec![late_joining(publisher(1, "map")), publisher(2, "map")];
    assert_eq!(said(&m.set_locals(vec![], both)), ["declare Publisher /map", "open /map 2"]);
    let fewer = ["close /map 1", "undeclare Publisher /map"];
    assert_eq!(said(&m.set_locals(vec![], vec![publisher(2, "map")])), fewer);
    assert_eq!(said(&m.token_down(&remote(1, 7, "MS", "map", ":1:,1:,:,:,,"))), ["stop out /map"]);
}

#[test]
fn what_runs_grows_without_a_stop() {
    let mut m = mirror(ZID, Filter::default());
    m.set_locals(vec![], vec![publisher(1, "x")]);
    m.token_up(&remote(1, 7, "MS", "x", QOS));
    let mut deeper = publisher(2, "x");
    deeper.qos.depth = 50;
    let grown = ["declare Publisher /x", "start out /x Volatile 50", "open /x 2"];
    assert_eq!(said(&m.set_locals(vec![], vec![publisher(1, "x"), deeper.clone()])), grown);
    let fewer = ["close /x 2", "undeclare Publisher /x"];
    assert_eq!(said(&m.set_locals(vec![], vec![publisher(1, "x")])), fewer);
    assert_eq!(
        said(&m.set_locals(vec![], vec![publisher(1, "x"), deeper])),
        ["declare Publisher /x", "open /x 2"]
    );
    let keeping = vec![publisher(1, "x"), late_joining(publisher(3, "x"))];
    let kept = &said(&m.set_locals(vec![], keeping))[..];
    assert!(kept.contains(&"start out /x TransientLocal 50".into()), "{kept:?}");
    assert!(!kept.iter().any(|action| action.starts_with("stop")), "{kept:?}");
}

#[test]
fn history_is_asked_for_if_both_ends_are_transient_local() {
    let mut m = mirror(ZID, Filter::default());
    m.set_locals(vec![], vec![late_joining(subscription(1, "map"))]);
    let keeper = remote(1, 7, "MP", "map", ":1:,3:,:,:,,");
    assert_eq!(said(&m.token_up(&keeper)), ["start in /map TransientLocal 3"]);
    let more = remote(1, 8, "MP", "map", ":1:,5:,:,:,,");
    assert_eq!(said(&m.token_up(&more)), ["start in /map TransientLocal 8"]);
    assert_eq!(said(&m.token_down(&more)), NOTHING);
    assert_eq!(said(&m.token_up(&more)), NOTHING);
    assert_eq!(
        said(&m.token_up(&remote(2, 9, "MP", "map", ":1:,1:,:,:,,"))),
        ["start in /map TransientLocal 16"],
        "by doubling, so that changes are few"
    );
    let volatile = vec![subscription(1, "map")];
    let changed = [
        "stop in /map",
        "declare Subscription /map",
        "start in /map Volatile 1",
        "undeclare Subscription /map",
    ];
    assert_eq!(said(&m.set_locals(vec![], volatile)), changed);
}

#[test]
fn keep_all_and_odd_depths() {
    let mut m = mirror(ZID, Filter::default());
    let mut deep = late_joining(subscription(1, "map"));
    deep.qos.depth = 2000;
    m.set_locals(vec![], vec![deep]);
    assert_eq!(
        said(&m.token_up(&remote(1, 7, "MP", "map", ":1:2,0:,:,:,,"))),
        ["start in /map TransientLocal 1000"]
    );
    m.set_locals(vec![], vec![late_joining(subscription(3, "few"))]);
    assert_eq!(
        said(&m.token_up(&remote(1, 8, "MP", "few", ":1:,4294967295:,:,:,,"))),
        ["start in /few TransientLocal 10"],
        "no more than who asks can get"
    );
    let mut endless = publisher(2, "log");
    endless.qos = WireQos { history: History::KeepAll, depth: 5000, ..endless.qos };
    m.set_locals(vec![], vec![endless]);
    assert_eq!(
        said(&m.token_up(&remote(1, 9, "MS", "log", "::,0:,:,:,,")))[0],
        "start out /log Volatile 5000"
    );
}

#[test]
fn denied_topics_are_neither_mirrored_nor_announced() {
    let mut m = mirror(ZID, Filter::new(&[], &["/secret/**".into()]).unwrap());
    m.token_up(&remote(1, 7, "MS", "secret%x", QOS));
    let locals = vec![publisher(1, "secret/x")];
    assert_eq!(
        said(&m.set_locals(vec![node(NodeName::new("/a", "node"))], locals)),
        ["declare node /a/node"]
    );
}

#[test]
fn nodes_without_endpoints_are_announced() {
    let mut m = mirror(ZID, Filter::default());
    assert_eq!(said(&m.set_locals(vec![node(NodeName::new("/", "n"))], vec![])), ["declare node /n"]);
    assert_eq!(
        said(&m.set_locals(vec![node(NodeName::new("/", "n"))], vec![publisher(1, "x")])),
        ["declare Publisher /x"]
    );
    assert_eq!(said(&m.set_locals(vec![node(NodeName::new("/", "n"))], vec![])), ["undeclare Publisher /x"]);
    assert_eq!(said(&m.close()), ["undeclare node /n"]);
}

#[test]
fn ids_are_never_used_twice() {
    let mut m = mirror(ZID, Filter::default());
    let mut ids = BTreeSet::new();
    for n in 0..100 {
        for action in m.set_locals(vec![], vec![publisher(n, "x")]) {
            if let Action::Declare(token) = action {
                assert!(ids.insert(token.endpoint.map_or(token.node_id, |endpoint| endpoint.id)));
            }
        }
    }
}

/// Hosts whose gateways see each other's tokens, as any Zenoh network of whatever shape lets them: what is published on
/// one arrives once on each that listens, and never comes back.
#[test]
fn a_network_of_hosts_neither_loops_nor_duplicates() {
    let seed =
        std::env::var("TAUT_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or_else(rand::random);
    println!("TAUT_SEED={seed}");
    let mut random = SmallRng::seed_from_u64(seed);
    for _ in 0..200 {
        let hosts: u8 = random.random_range(2..5);
        let mut mirrors: Vec<Mirror> =
            (0..hosts).map(|n| mirror(u128::from(n) + 1, Filter::default())).collect();
        let mut ends = vec![(0, 0); usize::from(hosts)];
        let mut flows = vec![(BTreeSet::<Gid>::new(), false); usize::from(hosts)];
        for _ in 0..40 {
            // Somebody's endpoints change; the tokens reach everybody, the session's own ones included.
            let host = random.random_range(0..usize::from(hosts));
            ends[host] = (random.random_range(0..3), random.random_range(0..3));
            let (publishers, subscriptions) = ends[host];
            let gid = |n: u8| host as u8 * 16 + n;
            let mut locals: Vec<_> = (0..publishers).map(|n| publisher(gid(n), "x")).collect();
            locals.extend((0..subscriptions).map(|n| subscription(gid(8 + n), "x")));
            let mut pending: Vec<(usize, Action)> =
                mirrors[host].set_locals(vec![], locals).into_iter().map(|action| (host, action)).collect();
            while !pending.is_empty() {
                let (at, action) = pending.remove(0);
                let (out, inward) = &mut flows[at];
                match &action {
                    Action::StartIn(..) => *inward = true,
                    Action::StopIn(..) => *inward = false,
                    Action::OpenWriter(_, writer) => assert!(out.insert(writer.local_gid)),
                    Action::CloseWriter(_, gid) => assert!(out.remove(gid)),
                    Action::StopOut(..) => out.clear(),
                    _ => {}
                }
                for (to, mirror) in mirrors.iter_mut().enumerate() {
                    let follow = match &action {
                        Action::Declare(token) => mirror.token_up(&token.to_string()),
                        Action::Undeclare(token) => mirror.token_down(&token.to_string()),
                        _ => continue,
                    };
                    pending.extend(follow.into_iter().map(|action| (to, action)));
                }
            }
            for (here, &(publishers, subscriptions)) in ends.iter().enumerate() {
                let others = || ends.iter().enumerate().filter(move |(there, _)| *there != here);
                let listened = others().any(|(_, &(_, subscriptions))| subscriptions > 0);
                let spoken = others().any(|(_, &(publishers, _))| publishers > 0);
                let (out, inward) = &flows[here];
                assert_eq!(out.len(), if listened { usize::from(publishers) } else { 0 }, "{ends:?}");
                assert!(
                    out.iter().all(|gid| usize::from(gid.0[0] / 16) == here),
                    "only what is from here goes out"
                );
                assert_eq!(*inward, subscriptions > 0 && spoken, "{ends:?}");
            }
        }
    }
}

/// As another gateway writes it: the tag, and the domains by which it came.
fn relayed(zid: u128, id: u64, kind: &str, topic: &str, tag: u64, path: &[u64]) -> String {
    let path: String = path.iter().map(|domain| format!("%{domain:016x}")).collect();
    let enclave = format!("%tautline%{tag:016x}%1%there{path}");
    remote(zid, id, kind, topic, QOS).replacen("/%/", &format!("/{enclave}/"), 1)
}

#[test]
fn what_others_announce_better_is_left_to_them() {
    let mut m = mirror(ZID, Filter::default());
    m.token_up(&remote(3, 1, "MS", "x", QOS));
    let told = Origin { tag: 7, ros: 1, place: "ros0".into(), ..Origin::default() };
    let ends = vec![LocalEndpoint { origin: told, ..publisher(1, "x") }, publisher(2, "x")];
    let began = m.set_locals(vec![], ends);
    assert!(said(&began).contains(&"open /x 1".into()), "{:?}", said(&began));
    assert_eq!(m.take_passed_over(), None);
    // On the network itself: nobody is nearer.
    let better = relayed(9, 1, "MP", "x", 7, &[]);
    assert_eq!(said(&m.token_up(&better)), NOTHING, "together with what else changes");
    assert_eq!(said(&m.settle()), ["close /x 1", "undeclare Publisher /x", "undeclare node /n"]);
    assert_eq!(m.take_passed_over(), Some([Gid([1; 16])].into()));
    assert!(!m.is_announced(&Gid([1; 16])) && m.is_announced(&Gid([2; 16])));
    assert_eq!((said(&m.settle()), m.take_passed_over()), (vec![], None));
    m.token_down(&better);
    assert_eq!(said(&m.settle()), ["declare node /n", "declare Publisher /x", "open /x 1"]);
    assert_eq!(m.take_passed_over(), Some(HashSet::new()));
    // One that is further away is no reason.
    m.token_up(&relayed(9, 1, "MP", "x", 7, &[21, 22, 23]));
    assert_eq!(said(&m.settle()), NOTHING);
}

#[test]
fn what_comes_another_way_is_passed_over() {
    let mut m = mirror(ZID, Filter::default());
    m.set_locals(vec![], vec![subscription(1, "x")]);
    assert_eq!(said(&m.token_up(&relayed(9, 1, "MP", "x", 7, &[21]))), ["start in /x Volatile 1"]);
    let rival = |hops| HashMap::from([(7, Rank { hops, ros: 1, teller: 5 })]);
    assert_eq!(said(&m.set_rivals(&rival(0))), ["stop in /x"], "somebody else here is nearer");
    assert_eq!(said(&m.token_up(&relayed(9, 2, "MP", "x", 8, &[21]))), ["start in /x Volatile 1"]);
    assert_eq!(m.passed_over_of(&key("x")).map(BTreeSet::len), Some(1));
    assert_eq!(said(&m.set_rivals(&rival(3))), ["pass over /x"]);
    assert_eq!(m.passed_over_of(&key("x")).map(BTreeSet::len), Some(0));
    // Of two that announce the same the nearer one counts; what has been here is nobody's.
    assert_eq!(said(&m.token_up(&relayed(10, 1, "MP", "x", 7, &[31, 32]))), ["pass over /x"]);
    let own = relayed(11, 1, "MP", "x", 9, &[ZID as u64, 21]);
    assert_eq!(said(&m.token_up(&own)), ["pass over /x"]);
    assert_eq!(m.passed_over_of(&key("x")).map(BTreeSet::len), Some(2));
}

/// Of what is kept, the samples that were left to somebody else have not been heard here.
#[test]
fn what_is_kept_is_asked_for_again_when_it_comes_this_way() {
    let mut m = mirror(ZID, Filter::default());
    m.set_locals(vec![], vec![late_joining(subscription(1, "map"))]);
    let kept = |id, tag| relayed(9, id, "MP", "map", tag, &[21]).replace("/::,10:", "/:1:,1:");
    m.token_up(&kept(1, 7));
    m.token_up(&kept(2, 8));
    let rivals = HashMap::from([(7, Rank { hops: 0, ros: 1, teller: 5 })]);
    assert_eq!(said(&m.set_rivals(&rivals)), ["pass over /map"]);
    let again = said(&m.set_rivals(&HashMap::new()));
    assert!(matches!(&*again, [one] if one.starts_with("start in /map TransientLocal")), "{again:?}");
}
