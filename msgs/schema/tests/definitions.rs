// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a definition may say, and what is said about one that is wrong.

use tautline_schema::{
    Base, Constant, Fault, Field, Kind, Packages, Primitive, Schema, SchemaError, Shape, TypeDescription,
    TypeName, Value, parse_action, parse_message, parse_service,
};

fn name(text: &str) -> TypeName {
    text.parse().unwrap()
}

fn schema(text: &str) -> Result<Schema, SchemaError> {
    Schema::from_text(&name("demo_msgs/msg/Demo"), text)
}

/// The line, the column and the fault of a message that is wrong.
#[track_caller]
fn fault(text: &str) -> (u32, u32, Fault) {
    match schema(text) {
        Err(SchemaError::Definition { place, fault }) => (place.line, place.column, fault),
        other => panic!("{other:?}"),
    }
}

/// The same for the text of a file.
#[track_caller]
fn fault_in_file(text: &str) -> (u32, u32, Fault) {
    match parse_message(&name("demo_msgs/msg/Demo"), "Demo.msg", text) {
        Err(SchemaError::Definition { place, fault }) => (place.line, place.column, fault),
        other => panic!("{other:?}"),
    }
}

#[test]
fn fields_have_types_shapes_and_defaults() {
    let text = "bool b\nstring<=5[<=3] names ['a', \"b,c\"]\nwstring w \"é\"\nother_msgs/Point[4] points\nLocal[] all\n\
                int32   spaced\t7\n  uint8 indented 0x10\n";
    let definition = parse_message(&name("demo_msgs/Demo"), "Demo.msg", text).unwrap();
    let field = |index: usize| -> &Field { &definition.fields[index] };
    assert_eq!(field(1).ty.to_string(), "string<=5[<=3]");
    assert_eq!(
        (field(1).ty.base.clone(), field(1).ty.shape),
        (Base::String { bound: Some(5) }, Shape::Bounded(3))
    );
    assert_eq!(field(1).default, Some(vec!["a".to_owned(), "b,c".to_owned()].into()));
    assert_eq!(field(1).default_text, "('a', 'b,c')");
    assert_eq!(field(2).default, Some("é".into()));
    assert_eq!(field(3).ty.base, Base::Nested(name("other_msgs/Point")));
    assert_eq!(field(4).ty.base, Base::Nested(name("demo_msgs/Local")));
    assert_eq!(field(5).default, Some(Value::I32(7)));
    assert_eq!(field(6).default, Some(Value::U8(16)));
    assert_eq!((field(6).place.line, field(6).place.column), (7, 3));
}

#[test]
fn constants_have_values() {
    let text =
        "uint8 A=1\nfloat32 B = -1.5\nstring C= 'it\\'s' # why\nchar D=65\nbool E=True\nint64 F=-0x10\n";
    let definition = parse_message(&name("demo_msgs/Demo"), "Demo.msg", text).unwrap();
    let constants: Vec<_> =
        definition.constants.iter().map(|Constant { name, value, .. }| (name.as_str(), value)).collect();
    assert_eq!(
        constants,
        [
            ("A", &Value::U8(1)),
            ("B", &Value::F32(-1.5)),
            ("C", &Value::String("it's".to_owned())),
            ("D", &Value::U8(65)),
            ("E", &Value::Bool(true)),
            ("F", &Value::I64(-16)),
        ]
    );
    assert_eq!(definition.constants[3].ty, Base::Primitive(Primitive::Char));
    assert!(definition.is_empty(), "constants alone leave a message empty");
}

#[test]
fn comments_become_docs() {
    let text = "# About\n# all.\n\n# Above\nint32 x # beside\n    # and on\n\n# For none\n";
    let definition = parse_message(&name("demo_msgs/Demo"), "Demo.msg", text).unwrap();
    assert_eq!(definition.docs, "About\nall.");
    assert_eq!(definition.fields[0].docs, "Above\nbeside\nand on");
}

#[test]
fn faults_have_a_place() {
    for (line, column, text, start) in [
        (1, 9, "uint8 x 256", "`256` is not a valid uint8: it needs to be from 0 to 255"),
        (2, 9, "\nint8 X= 200", "`200` is not a valid int8: it needs to be from -128 to 127"),
        (1, 11, "bool[2] x [true]", "`[true]` is not a valid list of 2 elements"),
        (1, 17, "string<=2 name  abc", "`abc` is not a valid string of at most 2 characters"),
        (1, 10, "string s \"a#b\"", "`\"a` is not a valid string: close it"),
    ] {
        let (at_line, at_column, fault) = fault(text);
        assert!(matches!(&fault, Fault::Value { .. }) && fault.to_string().starts_with(start), "{fault}");
        assert_eq!((at_line, at_column), (line, column), "{text}");
    }

    let named = |what: &str| what.to_owned();
    assert_eq!(fault("int32 a\nint32 b\nint16 a"), (3, 7, Fault::Duplicate { name: named("a") }));
    assert_eq!(fault("int8 A=1\nint8 A=2"), (2, 6, Fault::Duplicate { name: named("A") }));
    assert_eq!(fault_in_file("int32 Bad"), (1, 7, Fault::FieldName { name: named("Bad") }));
    assert_eq!(fault_in_file("int32 a__b"), (1, 7, Fault::FieldName { name: named("a__b") }));
    assert_eq!(fault_in_file("int32 class"), (1, 7, Fault::Keyword { name: named("class") }));
    assert_eq!(fault("int32 1st"), (1, 7, Fault::FieldName { name: named("1st") }));
    assert_eq!(fault("int32 bad=1"), (1, 7, Fault::ConstantName { name: named("bad") }));
    assert_eq!(fault("int32"), (1, 1, Fault::Line { line: named("int32") }));
    assert_eq!(fault("  int8 =5"), (1, 3, Fault::Line { line: named("int8 =5") }));
    assert_eq!(fault("int33 x"), (1, 1, Fault::Type { text: named("int33") }));
    assert_eq!(fault("int32] x"), (1, 1, Fault::Type { text: named("int32]") }));
    assert_eq!(fault("int32<=5 x"), (1, 1, Fault::Type { text: named("int32<=5") }));
    assert_eq!(fault("a/b/c/D x"), (1, 1, Fault::Type { text: named("a/b/c/D") }));
    for bound in ["0", "-1", "4294967296", "x", "+1"] {
        assert_eq!(fault(&format!("int32[{bound}] x")), (1, 1, Fault::Bound { text: named(bound) }));
    }
    assert_eq!(fault("string<=0 x"), (1, 1, Fault::Bound { text: named("0") }));
    assert_eq!(fault("int32[<=0] x"), (1, 1, Fault::Bound { text: named("0") }));
    assert_eq!(fault("int32[2] X=1"), (1, 1, Fault::ConstantType { text: named("int32[2]") }));
    assert_eq!(fault("demo_msgs/P X=1"), (1, 1, Fault::ConstantType { text: named("demo_msgs/P") }));
    assert_eq!(
        fault("P x 1\n===\nMSG: demo_msgs/P\nint8 a").2,
        Fault::NoDefault { text: named("demo_msgs/P") }
    );
}

#[test]
fn lines_end_as_python_reads_them() {
    let text = "# Docs\nint32 x 5 # beside\n\nP y\n===\nMSG: demo_msgs/P\nuint8 z\n";
    let expected = schema(text).unwrap();
    for end in ["\r\n", "\r"] {
        let read = schema(&text.replace('\n', end)).unwrap();
        assert_eq!((read.to_text(), read.hash()), (expected.to_text(), expected.hash()), "{end:?}");
    }
    assert_eq!(fault("int8 a\r\rint8 a\r"), (3, 6, Fault::Duplicate { name: "a".to_owned() }));
    let service = parse_service(&name("demo_msgs/srv/Demo"), "Demo.srv", "int8 a\r---\rint8 b\r").unwrap();
    assert_eq!(service[2].fields[0].name, "b");
}

#[test]
fn services_and_actions_need_their_separators() {
    let separators = |error: SchemaError| match error {
        SchemaError::Definition { fault: Fault::Separators { needed, found, .. }, .. } => (needed, found),
        other => panic!("{other:?}"),
    };
    let (service, action) = (name("demo_msgs/srv/Demo"), name("demo_msgs/action/Demo"));
    assert_eq!(separators(parse_service(&service, "Demo.srv", "int32 a").unwrap_err()), (1, 0));
    assert_eq!(separators(parse_service(&service, "Demo.srv", "---\n---").unwrap_err()), (1, 2));
    assert_eq!(separators(parse_action(&action, "Demo.action", "---").unwrap_err()), (2, 1));
    let error = parse_service(&service, "Demo.srv", "int32 a\n---\nint32 b\nint32 b").unwrap_err();
    assert_eq!(error.to_string(), "Demo.srv:4:7: `b` is defined twice: rename one of them");
    let derived = parse_action(&action, "Demo.action", "---\n---\n").unwrap();
    assert_eq!(derived.len(), 13);
}

#[test]
fn missing_recursive_and_huge_types_are_refused() {
    assert!(
        matches!(fault("int8 a\nThing t"), (2, 1, Fault::Unknown { name, .. }) if name == "demo_msgs/msg/Thing")
    );
    let loop_text = "A a\n===\nMSG: demo_msgs/A\nint8 x\nB[] b\n===\nMSG: demo_msgs/B\nA a\n";
    let (line, _, recursive) = fault(loop_text);
    assert_eq!(
        (line, recursive.to_string().as_str()),
        (8, "demo_msgs/msg/A > demo_msgs/msg/B > demo_msgs/msg/A: a message cannot contain itself")
    );
    assert!(matches!(fault("Demo[] again").2, Fault::Recursive { .. }));
    assert!(matches!(fault("int8 a\n===\nint8 x").2, Fault::Section { .. }));
    let twice = "A a\n===\nMSG: demo_msgs/A\nint8 x\n===\nMSG: demo_msgs/A\nint8 y\n";
    assert!(matches!(schema(twice), Err(SchemaError::Conflict { .. })));
    assert!(schema(&twice.replace("int8 y", "int8 x # again")).is_ok());

    assert!(matches!(schema("float64[4000000000] x"), Err(SchemaError::TooLarge { .. })));
    let doubling: String = (0..40)
        .map(|level| format!("A{next} a\nA{next} b\n===\nMSG: demo_msgs/A{next}\n", next = level + 1))
        .collect();
    assert!(matches!(schema(&(doubling + "int8 x")), Err(SchemaError::TooLarge { .. })));
    let deep: String = (0..100_000)
        .map(|level| format!("A{next} a\n===\nMSG: demo_msgs/A{next}\n", next = level + 1))
        .collect();
    assert!(matches!(fault(&(deep + "int8 x")).2, Fault::TooDeep));
}

#[test]
fn the_hash_ignores_names_of_constants_comments_and_defaults() {
    let plain = schema("int32 x\nchar[2] y\n").unwrap();
    let decorated = schema("# Docs\nint8 A=1\nint32 x 5 # docs\nuint8[2] y [1, 2]\n").unwrap();
    assert_eq!(plain.hash(), decorated.hash());
    assert_ne!(plain.hash(), schema("int32 x\nuint8[3] y\n").unwrap().hash());
    let again = Schema::from_text(decorated.name(), &decorated.to_text()).unwrap();
    assert_eq!(again.to_text(), "int8 A=1\nint32 x 5\nuint8[2] y [1, 2]\n");
}

/// C and C++ nodes can use these names; `rosidl_generator_py` warns of them.
#[test]
fn keywords_of_python_and_of_later_cpp_name_fields() {
    let text = "float64 lambda\nint8 from\nint8 in\nint8 is\nint8 pass\nint8 global\nbool requires\n";
    let definition = parse_message(&name("demo_msgs/Gains"), "Gains.msg", text).unwrap();
    assert_eq!(definition.fields[0].name, "lambda");
    assert_eq!(schema(text).unwrap().to_text(), text);
}

/// `rosidl_parser` checks no names of members. A stored definition of such a type is read again.
#[test]
fn members_of_idl_files_have_any_identifier() {
    let mut description = TypeDescription::from(&schema("string frame\nuint8[] data\n").unwrap());
    description.type_description.fields[0].name = "frameId".to_owned();
    description.type_description.fields[1].name = "data__".to_owned();
    let described = Schema::from_description(&description).unwrap();
    assert_eq!(described.to_text(), "string frameId\nuint8[] data__\n");
    assert_eq!(schema(&described.to_text()).unwrap().hash(), described.hash());
    description.type_description.fields[0].name = "frame id".to_owned();
    assert!(matches!(Schema::from_description(&description), Err(SchemaError::Description { .. })));
}

/// ROS 2 itself writes such descriptions: `rosidl_adapter` makes the default "°C" longer after it has checked its length.
#[test]
fn defaults_of_descriptions_that_do_not_fit_are_left_out() {
    let mut description =
        TypeDescription::from(&schema("string<=2 unit\nint8 count\nint8[2] two\nstring<=2 good\n").unwrap());
    let fields = &mut description.type_description.fields;
    for (field, default) in fields.iter_mut().zip(["Â°C", "200", "(1,)", "°C"]) {
        field.default_value = default.to_owned();
    }
    let described = Schema::from_description(&description).unwrap();
    let text = "string<=2 unit\nint8 count\nint8[2] two\nstring<=2 good \"°C\"\n";
    assert_eq!((described.to_text().as_str(), described.hash()), (text, description.hash()));
    assert_eq!(schema(text).unwrap().hash(), described.hash());
    assert_eq!(described.definition().fields[0].default_text, "");
}

/// The field that stands for none is a `uint8`; of another type it is a field.
#[test]
fn an_empty_message_has_one_byte() {
    let member = |ty: &str| schema(&format!("{ty} structure_needs_at_least_one_member\n")).unwrap();
    assert_eq!(
        (member("uint8").to_text().as_str(), member("uint8").hash()),
        ("", schema("").unwrap().hash())
    );
    for ty in ["int8", "float64", "uint8[2]"] {
        let text = format!("{ty} structure_needs_at_least_one_member\n");
        assert_eq!(member(ty).to_text(), text);
        assert_ne!(member(ty).hash(), schema("").unwrap().hash());
    }
}

/// The value that ROS 2 gives for `example_interfaces/srv/AddTwoInts`, without a ROS 2.
#[test]
fn a_service_has_the_hash_that_ros_gives_it() {
    let name = name("example_interfaces/srv/AddTwoInts");
    let mut packages = Packages::new();
    packages.add_text(&name, "AddTwoInts.srv", "int64 a\nint64 b\n---\nint64 sum\n").unwrap();
    let schema = packages.schema(&name).unwrap();
    assert_eq!(
        schema.hash().to_string(),
        "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
    );
    let request = packages.schema(&"example_interfaces/srv/AddTwoInts_Request".parse().unwrap()).unwrap();
    assert_eq!((request.name().kind(), request.to_text().as_str()), (Kind::Srv, "int64 a\nint64 b\n"));
}

/// As MCAP files and bags have it: separators of 80 characters, a name per section.
#[test]
fn text_of_bags_is_read() {
    let line = "=".repeat(80);
    let text = format!(
        "std_msgs/Header header\nPoint[] points # many\n{line}\nMSG: demo_msgs/Point\nfloat64 x\n{line}\r\n\
         MSG: std_msgs/Header\r\nbuiltin_interfaces/Time stamp\r\nstring frame_id\r\n{line}\n\
         MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    );
    let schema = schema(&text).unwrap();
    let names: Vec<_> = schema.referenced().map(|definition| definition.name.as_str()).collect();
    assert_eq!(names, ["builtin_interfaces/msg/Time", "demo_msgs/msg/Point", "std_msgs/msg/Header"]);
}
