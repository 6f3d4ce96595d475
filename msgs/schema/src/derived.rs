// SPDX-License-Identifier: MIT OR Apache-2.0
//! The messages and services that ROS derives from a service or an action.
//!
//! ```text
//! service Foo:  Foo_Request  Foo_Response  Foo_Event
//! action Foo:   Foo_Goal  Foo_Result  Foo_Feedback  Foo_FeedbackMessage
//!               Foo_SendGoal    with _Request, _Response, _Event
//!               Foo_GetResult   with _Request, _Response, _Event
//! ```

use std::sync::Arc;

use crate::{Base, Definition, Field, FieldType, Place, Primitive, Shape, TypeName};

/// `name` with a suffix: `Foo_Request`.
pub(crate) fn part(name: &TypeName, suffix: &str) -> TypeName {
    name.sibling(&format!("{}{suffix}", name.name()))
}

/// The services and actions that a type of this name could be derived from, the longest name first.
pub(crate) fn origins(name: &TypeName) -> Vec<TypeName> {
    let parts = name.name().rmatch_indices('_');
    std::iter::once(name.clone()).chain(parts.map(|(at, _)| name.sibling(&name.name()[..at]))).collect()
}

/// A service, its request, response and event.
pub(crate) fn service(name: &TypeName, request: Definition, response: Definition) -> Vec<Definition> {
    let file = request.file.clone();
    let event_name = part(name, "_Event");
    let single = |field: &str, name: &TypeName| nested(field, name, Shape::Single, &file);
    let at_most_one = |field: &str, name: &TypeName| nested(field, name, Shape::Bounded(1), &file);
    let event = message(
        &event_name,
        &file,
        vec![
            single("info", &TypeName::constant("service_msgs", "ServiceEventInfo")),
            at_most_one("request", &request.name),
            at_most_one("response", &response.name),
        ],
    );
    let service = message(
        name,
        &file,
        vec![
            single("request_message", &request.name),
            single("response_message", &response.name),
            single("event_message", &event_name),
        ],
    );
    vec![service, request, response, event]
}

/// An action and everything derived from it.
pub(crate) fn action(
    name: &TypeName,
    goal: Definition,
    result: Definition,
    feedback: Definition,
) -> Vec<Definition> {
    let file = goal.file.clone();
    let single = |field: &str, name: &TypeName| nested(field, name, Shape::Single, &file);
    let primitive = |field: &str, primitive| {
        let ty = FieldType { base: Base::Primitive(primitive), shape: Shape::Single };
        field_of(field, ty, &file)
    };
    let goal_id = || single("goal_id", &TypeName::constant("unique_identifier_msgs", "UUID"));

    let send_goal = part(name, "_SendGoal");
    let send_goal_service = service(
        &send_goal,
        message(&part(&send_goal, "_Request"), &file, vec![goal_id(), single("goal", &goal.name)]),
        message(
            &part(&send_goal, "_Response"),
            &file,
            vec![
                primitive("accepted", Primitive::Bool),
                single("stamp", &TypeName::constant("builtin_interfaces", "Time")),
            ],
        ),
    );
    let get_result = part(name, "_GetResult");
    let get_result_service = service(
        &get_result,
        message(&part(&get_result, "_Request"), &file, vec![goal_id()]),
        message(
            &part(&get_result, "_Response"),
            &file,
            vec![primitive("status", Primitive::I8), single("result", &result.name)],
        ),
    );
    let feedback_message =
        message(&part(name, "_FeedbackMessage"), &file, vec![goal_id(), single("feedback", &feedback.name)]);
    let action = message(
        name,
        &file,
        vec![
            single("goal", &goal.name),
            single("result", &result.name),
            single("feedback", &feedback.name),
            single("send_goal_service", &send_goal),
            single("get_result_service", &get_result),
            single("feedback_message", &feedback_message.name),
        ],
    );
    let mut all = vec![action, goal, result, feedback];
    all.extend(send_goal_service);
    all.extend(get_result_service);
    all.push(feedback_message);
    all
}

fn message(name: &TypeName, file: &Arc<str>, fields: Vec<Field>) -> Definition {
    Definition { name: name.clone(), fields, constants: vec![], docs: String::new(), file: file.clone() }
}

fn nested(name: &str, ty: &TypeName, shape: Shape, file: &Arc<str>) -> Field {
    field_of(name, FieldType { base: Base::Nested(ty.clone()), shape }, file)
}

fn field_of(name: &str, ty: FieldType, file: &Arc<str>) -> Field {
    Field {
        name: name.to_owned(),
        ty,
        default: None,
        default_text: String::new(),
        docs: String::new(),
        place: Place { file: file.clone(), line: 0, column: 0 },
    }
}
