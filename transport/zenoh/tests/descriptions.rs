// SPDX-License-Identifier: MIT OR Apache-2.0
//! Types that only a node elsewhere knows are asked of it; types that are known here are told who asks. The other is a
//! session of Zenoh that says what a ROS 2 node would.

mod support;

use std::sync::Arc;
use std::time::Duration;
use support::{Host, stats, until, wait};
use tautline_gateway::Direction;
use tautline_gateway::wire::{Attachment, Token, endpoint_gid};
use tautline_schema::{DynamicMessage, Packages, Schema, TypeDescription};
use tautline_transport::{Gid, Qos, SchemaStore, TopicType};
use zenoh::{Session, Wait};

const SERVICE: &str = "type_description_interfaces::srv::dds_::GetTypeDescription_";
const SERVICE_HASH: &str = "RIHS01_69b9c19c1021405984cc60dbbb1edceb147a6538b411d812ba6afabeed962cd5";

/// The definitions of ROS 2's service: its request or response.
fn service_schema(part: &str) -> Arc<Schema> {
    let folder =
        concat!(env!("CARGO_MANIFEST_DIR"), "/../../msgs/ros/definitions/type_description_interfaces");
    let mut packages = Packages::new();
    for kind in ["msg", "srv"] {
        for file in std::fs::read_dir(format!("{folder}/{kind}")).unwrap().flatten() {
            let path = file.path();
            let name =
                format!("type_description_interfaces/{kind}/{}", path.file_stem().unwrap().to_str().unwrap());
            let text = std::fs::read_to_string(&path).unwrap();
            packages.add_text(&name.parse().unwrap(), &name, &text).unwrap();
        }
    }
    let name = format!("type_description_interfaces/srv/GetTypeDescription_{part}");
    Arc::new(packages.schema(&name.parse().unwrap()).unwrap())
}

/// A type that nobody has ever heard of.
fn new_schema() -> Schema {
    let number: u64 = rand::random();
    let text = format!(
        "uint32 FIRST=1\nPart[] parts\nstring name_{number}\n{}\nMSG: a_msgs/Part\nfloat64 at\n",
        "=".repeat(80)
    );
    Schema::from_text(&"a_msgs/msg/Whole".parse().unwrap(), &text).unwrap()
}

struct Kept(String);

impl Drop for Kept {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(SchemaStore::of_user().path().join(&self.0));
    }
}

fn token(domain: u32, id: u64, kind: &str, name: &str, dds_type: &str, hash: &str) -> String {
    let name = name.replace('/', "%");
    format!("@ros2_lv/{domain}/beef/0/{id}/{kind}/%/%/their_node/{name}/{dds_type}/{hash}/::,10:,:,:,,")
}

fn publisher_of(
    session: &Session,
    domain: u32,
    topic: &str,
    hash: &str,
) -> Vec<zenoh::liveliness::LivelinessToken> {
    let service = "/their_node/get_type_description";
    [
        format!("@ros2_lv/{domain}/beef/0/0/NN/%/%/their_node"),
        token(domain, 1, "SS", service, SERVICE, SERVICE_HASH),
        token(domain, 2, "MP", topic, "a_msgs::msg::dds_::Whole_", hash),
    ]
    .map(|text| session.liveliness().declare_token(text).wait().unwrap())
    .into()
}

#[test]
fn a_type_that_only_another_knows_is_learned() {
    let host = Host::first(115, 115);
    let session = host.session();
    let schema = new_schema();
    let hash = schema.hash().to_string();
    let _kept = Kept(hash.clone());
    let (request, response) = (service_schema("Request"), service_schema("Response"));
    let description = serde_json::to_value(TypeDescription::from(&schema)).unwrap();
    let liar = serde_json::to_value(TypeDescription::from(&new_schema())).unwrap();
    let answer = move |query: zenoh::query::Query| {
        let asked = DynamicMessage::from_cdr(&request, &query.payload().unwrap().to_bytes()).unwrap();
        let asked = asked.to_json_value();
        assert_eq!(asked["type_name"], "a_msgs/msg/Whole");
        assert!(Attachment::parse(&query.attachment().unwrap().to_bytes()).is_ok());
        let is_truth = asked["type_hash"] == schema.hash().to_string();
        let description = if is_truth { description.clone() } else { liar.clone() };
        let reply = serde_json::json!({ "successful": true, "type_description": description });
        let reply = DynamicMessage::from_json_value(&response, &reply).unwrap().to_cdr();
        query.reply(query.key_expr().clone(), reply).wait().unwrap();
    };
    let key = format!("115/their_node/get_type_description/{SERVICE}/{SERVICE_HASH}");
    let _queryable = session.declare_queryable(key).complete(true).callback(answer).wait().unwrap();
    let _tokens = publisher_of(&session, 115, "/theirs", &hash);
    let topic_type = wait("their topic", || host.participant.topic_type("/theirs").unwrap());
    assert_eq!(topic_type, TopicType::new("a_msgs/msg/Whole").with_hash(hash.clone()));
    assert!(SchemaStore::of_user().read(&hash).unwrap().is_none(), "nobody here wants it yet");

    let _subscription = host.subscription("/theirs", &topic_type, Qos::default());
    let kept = wait("the definition", || SchemaStore::of_user().read(&hash).unwrap());
    let learned = Schema::from_text(&"a_msgs/msg/Whole".parse().unwrap(), &kept.text).unwrap();
    assert_eq!(learned.hash().to_string(), hash);
    until("the count", || host.stats().type_descriptions.get("learned") == Some(&1));
    // From then on, what is no message of this type is dropped: this one claims 2^31 - 1 parts.
    let publisher = token(115, 2, "MP", "/theirs", "a_msgs::msg::dds_::Whole_", &hash);
    let gid = endpoint_gid(&Token::parse(&publisher).unwrap());
    let attachment = Attachment { sequence_number: 1, source_timestamp_ns: 1, gid }.encode();
    until("a check of the content", || {
        let body = [0, 1, 0, 0, 0xFF, 0xFF, 0xFF, 0x7F];
        let put = session.put(format!("115/theirs/a_msgs::msg::dds_::Whole_/{hash}"), body);
        put.attachment(&attachment[..]).wait().unwrap();
        let inward = stats(&host, "/theirs", Direction::In);
        inward.is_some_and(|inward| inward.reading.dropped.contains_key("not a message of its type"))
    });

    // Of this one it tells another.
    let other = new_schema().hash().to_string();
    let _other = session
        .liveliness()
        .declare_token(token(115, 3, "MP", "/lies", "a_msgs::msg::dds_::Whole_", &other))
        .wait()
        .unwrap();
    let topic_type = TopicType::new("a_msgs/msg/Whole").with_hash(other.clone());
    let _subscription = host.subscription("/lies", &topic_type, Qos::default());
    let lie = "a description of another type than asked for";
    until("the lie's count", || host.stats().type_descriptions.get(lie) == Some(&1));
    assert!(SchemaStore::of_user().read(&other).unwrap().is_none());
}

#[test]
fn nodes_here_are_asked_for_their_types() {
    let host = Host::first(116, 116);
    let session = host.session();
    let schema = new_schema();
    let hash = schema.hash().to_string();
    let _kept = Kept(hash.clone());
    let _node = host.participant.create_node("our_node", "/ours").unwrap();
    SchemaStore::of_user().keep(&hash, &schema.to_text()).unwrap();

    // It is announced, as a ROS 2 node announces its own.
    let tokens =
        session.liveliness().declare_subscriber("@ros2_lv/116/*/*/*/SS/**").history(true).wait().unwrap();
    let text = tokens.recv_timeout(Duration::from_secs(20)).unwrap().unwrap().key_expr().to_string();
    let announced = Token::parse(&text).unwrap().endpoint.unwrap();
    assert_eq!(announced.name, "/ours/our_node/get_type_description");
    assert_eq!(announced.type_id.hash.to_string(), SERVICE_HASH);

    let key = format!("116/ours/our_node/get_type_description/{SERVICE}/{SERVICE_HASH}");
    let (request, response) = (service_schema("Request"), service_schema("Response"));
    let ask = |hash: &str| {
        let request_json = serde_json::json!({ "type_name": "a_msgs/msg/Whole", "type_hash": hash });
        let payload = DynamicMessage::from_json_value(&request, &request_json).unwrap().to_cdr();
        let attachment = Attachment { sequence_number: 7, source_timestamp_ns: 1, gid: Gid([9; 16]) };
        wait("an answer", || {
            let replies = (session.get(&key).payload(payload.clone()))
                .attachment(attachment.encode().as_slice())
                .timeout(Duration::from_secs(5))
                .wait()
                .unwrap();
            let reply = replies.recv().ok()?;
            let sample = reply.into_result().ok()?;
            let echoed = Attachment::parse(&sample.attachment().unwrap().to_bytes()).unwrap();
            assert_eq!((echoed.sequence_number, echoed.gid), (7, Gid([9; 16])));
            Some(DynamicMessage::from_cdr(&response, &sample.payload().to_bytes()).unwrap().to_json_value())
        })
    };
    let mut answer = ask(&hash);
    assert_eq!(answer["successful"], true);
    let description: TypeDescription = serde_json::from_value(answer["type_description"].take()).unwrap();
    assert_eq!(description.hash().to_string(), hash);
    let unknown = new_schema().hash().to_string();
    let answer = ask(&unknown);
    assert_eq!(answer["successful"], false);
    assert!(answer["failure_reason"].as_str().unwrap().contains("not known on this host"), "{answer}");
    until("the counts", || host.stats().type_descriptions.contains_key("answered"));
}
