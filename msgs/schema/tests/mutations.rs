// SPDX-License-Identifier: MIT OR Apache-2.0
//! Input that is almost right: changed, cut and joined at random. Nothing may panic or allocate without bound.

use std::sync::Arc;

use rand::RngExt;
use rand::seq::IndexedRandom;
use tautline_schema::{
    DynamicMessage, Endian, HashedTypeDescription, Layout, MessageError, Schema, TypeName, parse_action,
    parse_message, parse_service,
};

/// Inputs per parser and decoder.
const COUNT: usize = 200_000;

const DEFINITION: &str = "# Docs\nint32 x 5 # beside\nuint8 A=0x1F\nstring<=9 B=\"a\\\"b\"\nfloat64[<=3] f [1.5, -2e3]\n\
    string[] s ['a', \"b,c\"]\nbool[2] b [true, 0]\nwstring<=4[3] w\nInner[2] inner\nbyte y 7\nchar c\nInner[] more\n";
const BUNDLE: &str = "\n================\nMSG: demo_msgs/Inner\nLeaf leaf\nfloat32[] n\nuint64 u\n================\n\
    MSG: demo_msgs/Leaf\nstring name\nwstring wide\nbool ok\nint16[3] i\n";
const YAML: &str = "x: 1\nf: [.nan, 1.0e-3]\ns: ['a', b]\nb: [true, false]\nw: ['', 'é', 'x']\ninner:\n- leaf: {name: a}\n  n:\n  - 1\n\
    - {u: 18446744073709551615}\ny: 255\nmore: [{leaf: {ok: true, i: [1, 2, 3]}}]\n";

fn schema() -> Arc<Schema> {
    Arc::new(Schema::from_text(&name("demo_msgs/msg/Demo"), &format!("{DEFINITION}{BUNDLE}")).unwrap())
}

fn name(text: &str) -> TypeName {
    text.parse().unwrap()
}

/// Runs `check` with mutations of `inputs`, whose parts are mixed with `words`.
fn mutate(inputs: &[Vec<u8>], words: &[&[u8]], mut check: impl FnMut(&[u8])) {
    let mut rng = tautline_seed::random();
    for _ in 0..COUNT {
        let mut input = inputs.choose(&mut rng).cloned().unwrap_or_default();
        for _ in 0..rng.random_range(1..6) {
            let at = rng.random_range(0..=input.len());
            match rng.random_range(0..7) {
                0 => input.truncate(at),
                1 if at < input.len() => input[at] ^= 1 << rng.random_range(0..8),
                2 if at < input.len() => input[at] = rng.random(),
                3 if at + 4 <= input.len() => {
                    let number = *[0, 1, 0x7fff_ffff, u32::MAX, 0x100, 9].choose(&mut rng).unwrap_or(&0);
                    input[at..at + 4].copy_from_slice(&number.to_le_bytes());
                }
                4 => {
                    let end = (at + rng.random_range(0..20)).min(input.len());
                    input.drain(at..end);
                }
                5 => {
                    let word = words.choose(&mut rng).copied().unwrap_or_default();
                    input.splice(at..at, word.iter().copied());
                }
                _ => {
                    let end = (at + rng.random_range(0..40)).min(input.len());
                    let copy = input[at..end].to_vec();
                    let to = rng.random_range(0..=input.len());
                    input.splice(to..to, copy);
                }
            }
        }
        check(&input);
    }
}

#[rustfmt::skip]
const WORDS: &[&[u8]] = &[
    b"\n", b" ", b"#", b"---\n", b"=", b"<=", b"[", b"]", b"[<=4294967295]", b"[999999999]", b"0x", b"-",
    b"\"", b"\\", b"'", b"\\u12", b"\xc3\xa9", b"\xff", b"MSG: ", b"===\n", b"1e999", b"_", b"Inner",
    b"int64", b"string", b",", b"Demo d\n", b"\t", b"\r\n", b"nan", b"+", b": ", b"- ", b"{", b"}", b"&a ",
    b"*a", b"!!str ", b"|", b">", b"? ", b"null", b"\0",
];

#[test]
fn definitions() {
    let inputs = [DEFINITION.into(), format!("{DEFINITION}---\n{DEFINITION}---\nint8 x\n").into_bytes()];
    let (message, service, action) = (name("d/msg/D"), name("d/srv/D"), name("d/action/D"));
    mutate(&inputs, WORDS, |input| {
        let text = String::from_utf8_lossy(input);
        let _ = parse_message(&message, "D.msg", &text);
        let _ = parse_service(&service, "D.srv", &text);
        let _ = parse_action(&action, "D.action", &text);
    });
}

/// What is accepted must be written as text that gives the same type.
#[test]
fn bundles() {
    let inputs = [format!("{DEFINITION}{BUNDLE}").into_bytes()];
    let demo = name("demo_msgs/msg/Demo");
    let mut accepted = 0;
    mutate(&inputs, WORDS, |input| {
        if let Ok(schema) = Schema::from_text(&demo, &String::from_utf8_lossy(input)) {
            let again = Schema::from_text(&demo, &schema.to_text()).unwrap();
            assert_eq!((again.hash(), again.to_text()), (schema.hash(), schema.to_text()));
            let _ = Layout::of(&schema);
            accepted += 1;
        }
    });
    println!("{accepted} accepted");
    assert!(accepted > COUNT / 100);
}

/// What is accepted must be written as text that gives the same type.
#[test]
fn descriptions() {
    let inputs = [HashedTypeDescription::from(&*schema()).to_json().into_bytes()];
    mutate(&inputs, &[b"1", b"0", b"145", b"\"", b"4294967296", b"demo_msgs/msg/Demo"], |input| {
        if let Ok(read) = serde_json::from_slice::<HashedTypeDescription>(input) {
            let _ = read.type_description_msg.hash();
            if let Ok(schema) = Schema::from_description(&read.type_description_msg) {
                let again = Schema::from_text(schema.name(), &schema.to_text()).unwrap();
                assert_eq!((again.hash(), again.to_text()), (schema.hash(), schema.to_text()));
            }
        }
    });
}

/// What is accepted must be written as bytes that give the same value.
#[test]
fn bytes() {
    let schema = schema();
    let filled = DynamicMessage::from_yaml(&schema, YAML).unwrap();
    let inputs = [DynamicMessage::new(&schema).to_body(), filled.to_body()];
    let mut accepted = 0;
    mutate(&inputs, &[b"\0\0\0\0", b"\x01\0\0\0", b"\xff\xff\xff\xff"], |input| {
        let _ = DynamicMessage::from_cdr(&schema, input);
        let validated = |endian, decoded: &Result<DynamicMessage, MessageError>| {
            let trailing = decoded.as_ref().map(DynamicMessage::trailing_bytes).map_err(ToString::to_string);
            let validated = DynamicMessage::validate(&schema, input, endian);
            assert_eq!(validated.map_err(|error| error.to_string()), trailing);
        };
        validated(Endian::Big, &DynamicMessage::from_body(&schema, input, Endian::Big));
        let decoded = DynamicMessage::from_body(&schema, input, Endian::Little);
        validated(Endian::Little, &decoded);
        if let Ok(message) = decoded {
            let body = message.to_body();
            let again = DynamicMessage::from_body(&schema, &body, Endian::Little).unwrap();
            assert_eq!((again.to_json(), again.trailing_bytes()), (message.to_json(), 0));
            accepted += 1;
        }
    });
    println!("{accepted} accepted");
    assert!(accepted > COUNT / 100);
}

#[test]
fn json_and_yaml() {
    let schema = schema();
    let json = DynamicMessage::from_yaml(&schema, YAML).unwrap().to_json();
    mutate(&[json.into_bytes(), YAML.into()], WORDS, |input| {
        let text = String::from_utf8_lossy(input);
        let _ = DynamicMessage::from_json(&schema, &text);
        if let Ok(message) = DynamicMessage::from_yaml(&schema, &text) {
            let yaml = message.to_string();
            let again =
                DynamicMessage::from_yaml(&schema, &yaml).unwrap_or_else(|error| panic!("{error}: {yaml}"));
            assert_eq!(again.to_json(), message.to_json(), "{yaml}");
        }
    });
}

#[test]
fn paths() {
    let mut message = DynamicMessage::from_yaml(&schema(), YAML).unwrap();
    let inputs: Vec<Vec<u8>> = [&b"inner[0].leaf.i[2]"[..], b"more[0].n", b"f[1]"].map(Into::into).into();
    mutate(&inputs, &[b".", b"[", b"]", b"[0]", b"leaf", b"99999999999999999999"], |input| {
        let path = String::from_utf8_lossy(input);
        let _ = message.get(&path);
        let _ = message.set(&path, 1);
    });
}
