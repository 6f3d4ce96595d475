// SPDX-License-Identifier: MIT OR Apache-2.0
//! What shells are offered, asked as their scripts ask; and what the script of bash makes of it.

mod support;

use std::os::unix::fs::symlink;
use std::process::{Command, Output};
use std::time::Duration;
use support::Here;
use tautline::example_interfaces::action::Fibonacci;
use tautline::lifecycle::CallbackReturn;
use tautline::rcl_interfaces::srv::ListParameters;
use tautline::std_srvs::srv::{SetBool, Trigger};
use tautline::{Context, LifecycleCallbacks, LifecycleNode, ManagedNode, Node, Qos, Realtime};
use tautline_schema::Schema;
use tautline_transport::{Limits, Participant, RawPublisher, TopicType};

const DOMAIN: u32 = 69;
/// Nobody is there.
const EMPTY: u32 = 72;
const TAUT: &str = env!("CARGO_BIN_EXE_taut");

fn ask(shell: &str, words: &[&str], index: usize) -> Output {
    let mut taut = Command::new(TAUT);
    taut.arg("--").args(words).envs([("COMPLETE", shell), ("TAUT_DOMAIN", "69"), ("RUST_LOG", "trace")]);
    // A machine that has no time makes answers late.
    taut.env("TAUT_TIME_SCALE", "10");
    // fish says nothing of these two.
    if shell != "fish" {
        taut.env("_CLAP_COMPLETE_INDEX", index.to_string()).env("_CLAP_IFS", "\n");
    }
    taut.output().unwrap()
}

/// What is offered for the last word of a line, by this shell's way to say it.
fn offered_to(shell: &str, line: &str) -> Vec<String> {
    let words: Vec<&str> = line.split(' ').collect();
    let output = ask(shell, &words, words.len() - 1);
    assert!(output.status.success() && output.stderr.is_empty(), "{line}: {output:?}");
    String::from_utf8(output.stdout).unwrap().lines().map(str::to_owned).collect()
}

fn offered(line: &str) -> Vec<String> {
    offered_to("bash", line)
}

/// This is offered, once the machine has time: an answer that takes long is given up.
#[track_caller]
fn offers_to(shell: &str, line: &str, expected: &[&str]) {
    let mut last = Vec::new();
    for _ in 0..200 {
        last = offered_to(shell, line);
        if last == expected {
            return;
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    panic!("{shell}: {line}: {last:?}, not {expected:?}");
}

#[track_caller]
fn offers(line: &str, expected: &[&str]) {
    offers_to("bash", line, expected);
}

fn publisher(participant: &Participant, topic: &str) -> RawPublisher {
    let text = "Part[] parts\nbuiltin_interfaces/Time stamp\n===\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n===\n\
                MSG: demo_msgs/Part\nstring name\n";
    let schema = Schema::from_text(&"demo_msgs/msg/Scan".parse().unwrap(), text).unwrap();
    let topic_type = TopicType::new(schema.name().to_string())
        .with_hash(schema.hash().to_string())
        .with_definition(schema.to_text());
    participant.create_raw_publisher(topic, &topic_type, Qos::default(), Limits::default()).unwrap()
}

struct Quiet;

impl LifecycleCallbacks for Quiet {
    fn on_cleanup(&mut self, _node: &mut ManagedNode) -> CallbackReturn {
        CallbackReturn::Failure
    }
}

fn parameters(node: &mut Node) {
    node.declare_parameter("gain", 1.5).unwrap();
    node.declare_parameter("arm.speed", 3).unwrap();
}

#[test]
fn names_of_what_exists_are_offered() {
    let here = Here::new(DOMAIN);
    let participant = Participant::new(DOMAIN).unwrap();
    let topics = ["/image", "/robot/imu", "/robot/map"].map(|topic| publisher(&participant, topic));
    let mut arm = here.node("arm", "/robot");
    let qos = Qos::services_default();
    let _lights = arm.create_service::<SetBool::Service>("/robot/lights", qos).unwrap();
    let _reset = arm.create_service::<Trigger::Service>("/reset", qos).unwrap();
    let _client = arm.create_client::<Trigger::Service>("/unserved").unwrap();
    let _goals = arm.create_action_server::<Fibonacci::Action>("/robot/count").unwrap();

    // Topics, typed with and without a slash, after options, and before them.
    offers("taut topic echo /im", &["/image"]);
    offers("taut topic echo im", &["/image"]);
    offers("taut topic echo /robot/", &["/robot/imu", "/robot/map"]);
    offers("taut topic hz --every 2s robot/i", &["/robot/imu"]);
    offers("taut topic echo --once -n 3 --field stamp.sec /im", &["/image"]);
    offers("taut topic echo ", &["/image", "/robot/imu", "/robot/map"]);
    offers("taut topic info /robot/count/_action/f", &["/robot/count/_action/feedback"]);
    for verb in ["info", "type", "hz", "bw", "delay", "pub"] {
        offers(&format!("taut topic {verb} /i"), &["/image"]);
    }
    offers("taut topic find demo", &["demo_msgs/msg/Scan"]);
    offers("taut topic find demo_msgs/S", &["demo_msgs/msg/Scan"]);
    offers("taut topic pub image ", &["demo_msgs/msg/Scan"]);
    offers("taut topic pub /new demo", &["demo_msgs/msg/Scan"]);
    assert!(offered("taut topic pub /image demo_msgs/msg/Scan ").is_empty());
    offers("taut topic echo /image --field ", &["parts", "stamp", "stamp.nanosec", "stamp.sec"]);
    offers("taut topic echo image --field=parts[2].", &["--field=parts[2].name"]);

    // Nodes, services, actions.
    offers("taut node info ", &["/robot/arm"]);
    offers("taut node info robot/a", &["/robot/arm"]);
    offers("taut service type /", &["/reset", "/robot/lights", "/unserved"]);
    offers("taut service call r", &["/reset", "/robot/lights"]);
    offers("taut service call /reset ", &["std_srvs/srv/Trigger"]);
    offers("taut service find std_srvs/S", &["std_srvs/srv/SetBool"]);
    offers("taut action info ", &["/robot/count"]);
    offers("taut action send_goal robot/c", &["/robot/count"]);
    offers("taut action send_goal /robot/count ", &["example_interfaces/action/Fibonacci"]);

    // Each shell in its way: what stands beside a name, and what the shell would drop since it does not begin with the word.
    offers_to("fish", "taut topic echo im", &["/image\tdemo_msgs/msg/Scan"]);
    offers_to("zsh", "taut topic echo im", &["image:demo_msgs/msg/Scan"]);
    offers_to("zsh", "taut topic echo /im", &["/image:demo_msgs/msg/Scan"]);
    offers_to("elvish", "taut topic find demo_msgs/S", &["demo_msgs/Scan"]);

    // The domain is the line's; in one where nobody is, there is nothing to offer, nor in one that is none.
    assert!(offered(&format!("taut topic echo --domain {EMPTY} /")).is_empty());
    assert!(offered(&format!("taut topic --domain={EMPTY} echo ")).is_empty());
    assert!(offered("taut topic echo --domain 300 /").is_empty());
    assert!(offered("taut topic echo --domain x /").is_empty());
    let words = ["taut", "topic", "echo", "/i", "--domain", "72"];
    assert!(ask("bash", &words, 3).stdout.is_empty());
    assert!(offered("taut topic echo /nothing").is_empty());
    // A word that is not there is an empty one.
    let is_offered = || ask("bash", &["taut", "topic", "echo"], 9).stdout.starts_with(b"/image\n");
    assert!((0..200).any(|_| is_offered()));

    by_bash();
    drop((topics, arm));
    here.context.shutdown();
}

/// The script, sourced by a real bash, and its function, called as bash would.
fn by_bash() {
    let folder = tempfile::tempdir().unwrap();
    let program = folder.path().join("it's a \"taut\"");
    symlink(TAUT, &program).unwrap();
    let script = "source <(\"$TAUT\" completions bash) && declare -F _clap_complete_taut > /dev/null && complete -p taut > /dev/null || exit
        COMP_TYPE=9
        COMP_WORDS=(taut topic echo im) COMP_CWORD=3
        _clap_complete_taut taut im echo && echo \"${COMPREPLY[@]}\"
        COMP_WORDS=(taut topic --domain = 69 echo /robot/) COMP_CWORD=6
        _clap_complete_taut taut /robot/ echo && echo \"${COMPREPLY[@]}\"
        COMP_WORDS=(taut topic echo /image --field = sta) COMP_CWORD=6
        _clap_complete_taut taut sta = && echo \"${COMPREPLY[@]}\"
        shopt -s nullglob
        COMP_WORDS=(taut topic echo /image --field 'parts[2].') COMP_CWORD=5
        _clap_complete_taut taut 'parts[2].' --field && echo \"${COMPREPLY[@]}\" && echo /us*";
    let mut last = String::new();
    for _ in 0..100 {
        let mut bash = Command::new("bash");
        bash.args(["--norc", "-c", script])
            .envs([("TAUT", program.as_os_str()), ("TAUT_DOMAIN", "69".as_ref())]);
        let output = bash.output().unwrap();
        assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
        last = String::from_utf8(output.stdout).unwrap();
        if last == "/image\n/robot/imu /robot/map\nstamp stamp.nanosec stamp.sec\nparts[2].name\n/usr\n" {
            return;
        }
    }
    panic!("{last}");
}

/// In a domain of its own, where nothing else delays an answer.
#[test]
fn nodes_are_asked_and_the_silent_ones_are_left_out() {
    const DOMAIN: u32 = 74;
    let mut here = Here::new(DOMAIN);
    let mut control = here.node("control", "");
    parameters(&mut control);
    let (handler, _changes) = control.make_parameter_handler().unwrap();
    here.serve(&mut control, handler);
    let camera = LifecycleNode::create(here.context.clone(), "camera", "/robot", Quiet).unwrap();
    let states = camera.serve_states().unwrap();
    camera.with_node(|node| here.serve(node, states)).unwrap();
    let mut asleep = here.node("asleep", "");
    let qos = Qos::services_default();
    let _silent = asleep.create_service::<ListParameters::Service>("~/list_parameters", qos).unwrap();
    // This one does not spin.
    let context = Context::builder().domain(DOMAIN).realtime(Realtime::Off).build().unwrap();
    let mut stopped = Node::create(context, "stopped", "").unwrap();
    parameters(&mut stopped);
    let _stopped = stopped.make_parameter_handler().unwrap();

    let of = |line: &str| line.replacen("taut param", "taut param --domain 74", 1);
    offers(&of("taut param list "), &["/asleep", "/control", "/stopped"]);
    offers(&of("taut param dump co"), &["/control"]);
    offers(&of("taut param get /control "), &["arm.speed", "gain", "use_sim_time"]);
    offers(&of("taut param get control ar"), &["arm.speed"]);
    offers(&of("taut param describe control arm.speed "), &["gain", "use_sim_time"]);
    for verb in ["set", "delete"] {
        offers(&of(&format!("taut param {verb} control g")), &["gain"]);
    }
    for node in ["asleep", "stopped", "nobody", "/robot/camera"] {
        assert!(offered(&of(&format!("taut param get {node} "))).is_empty(), "{node}");
    }
    assert!(offered(&of("taut param set control gain ")).is_empty());

    offers("taut lifecycle --domain 74 set ", &["/robot/camera"]);
    offers("taut lifecycle --domain 74 set robot/camera ", &["configure", "shutdown"]);
    assert!(offered("taut component --domain 74 unload ").is_empty());
}

#[test]
fn verbs_options_and_files_are_offered() {
    let topic = ["bw", "delay", "echo", "find", "help", "hz", "info", "list", "pub", "type"];
    let mut verbs = offered("taut topic ");
    verbs.sort();
    assert_eq!(verbs, topic);
    assert_eq!(offered("taut component load libx.so --log-level e"), ["error"]);
    assert_eq!(offered("taut top --sort t"), ["trouble"]);
    assert_eq!(offered("taut topic list --dom"), ["--domain"]);
    assert!(offered("taut topic list ").contains(&"--json".to_owned()));
    let folder = tempfile::tempdir().unwrap();
    let package = folder.path().join("demo_msgs/srv");
    std::fs::create_dir_all(&package).unwrap();
    std::fs::write(package.join("Get.srv"), "---\n").unwrap();
    let path = folder.path().to_str().unwrap();
    offers(&format!("taut msg show --path {path} demo_msgs/"), &["demo_msgs/srv/Get"]);
    offers_to("zsh", &format!("taut msg hash --path {path} demo_msgs/G"), &["demo_msgs/Get"]);
    let file = format!("{path}/demo_msgs/srv/Get.srv");
    offers(&format!("taut msg show {path}/demo_msgs/srv/G"), &[&file]);
    offers(&format!("taut check {path}/demo_msgs/srv/"), &[&file]);
}

#[test]
fn every_shell_has_its_script() {
    for (shell, part) in [
        ("bash", "complete -o nospace -o bashdefault -o nosort -F _clap_complete_taut taut"),
        ("zsh", "compdef _clap_dynamic_completer_taut taut"),
        ("fish", "complete --keep-order --exclusive --command taut"),
        ("elvish", "set edit:completion:arg-completer[taut]"),
        ("powershell", "Register-ArgumentCompleter -Native -CommandName taut"),
    ] {
        let by_verb = Command::new(TAUT).args(["completions", shell]).output().unwrap();
        let script = String::from_utf8(by_verb.stdout).unwrap();
        assert!(
            script.contains(part) && script.contains("COMPLETE") && script.contains(TAUT),
            "{shell}: {script}"
        );
        let by_variable = Command::new(TAUT).env("COMPLETE", shell).output().unwrap();
        assert_eq!(String::from_utf8(by_variable.stdout).unwrap(), script);
    }
    // Somebody else's variable.
    let output = Command::new(TAUT).env("COMPLETE", "1").arg("--version").output().unwrap();
    assert!(output.status.success() && output.stdout.starts_with(b"taut "), "{output:?}");
}
