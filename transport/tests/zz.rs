mod support;
use support::*;
use tautline_transport::*;
fn fds() -> usize { std::fs::read_dir("/proc/self/fd").unwrap().count() }
fn maps() -> usize { std::fs::read_to_string("/proc/self/maps").unwrap().lines().count() }
#[test]
fn fdcount() {
    let participant = Participant::new(199).unwrap();
    let limits = Limits { publishers: 64, subscribers: 128, depth: 4, held: 1, loans: 1 };
    let qos = Qos::keep_last(4);
    println!("start {} {}", fds(), maps());
    let ps: Vec<_> = (0..10).map(|_| participant.create_publisher::<Count>("/many", qos, limits).unwrap()).collect();
    println!("10 pubs {} {}", fds(), maps());
    let ss: Vec<_> = (0..10).map(|_| participant.create_subscription::<Count>("/many", qos, limits).unwrap()).collect();
    println!("10 subs {} {}", fds(), maps());
    for p in &ps { p.publish(&Count{n:1}).unwrap(); }
    println!("publish 100 conns {} {}", fds(), maps());
    for s in &ss { take_all(s); }
    println!("take 100 conns {} {}", fds(), maps());
    for p in std::fs::read_dir("/proc/self/fd").unwrap().flatten().rev_take() { println!("{:?}", p); }
}
trait R { fn rev_take(self) -> Vec<std::path::PathBuf>; }
impl<I: Iterator<Item=std::fs::DirEntry>> R for I { fn rev_take(self) -> Vec<std::path::PathBuf> { let v: Vec<_> = self.filter_map(|e| std::fs::read_link(e.path()).ok()).collect(); v.into_iter().rev().step_by(10).take(30).collect() } }
