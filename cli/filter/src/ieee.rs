// SPDX-License-Identifier: MIT OR Apache-2.0
//! Comparisons with NaN as in IEEE 754: `<`, `<=`, `>` and `>=` are false. To jq, NaN is less than every number.

use jaq_core::load::lex::StrPart;
use jaq_core::load::parse::{BinaryOp, Def, Pattern, Term};
use jaq_core::ops::Cmp;
use jaq_core::path::{Part, Path};

/// The functions that replace the operators, whose names no program can contain. Only NaN differs from itself.
const COMPARISONS: [(&str, &str); 4] = [
    ("!<", "l as $l | r as $r | $l == $l and $r == $r and $l < $r"),
    ("!<=", "l as $l | r as $r | $l == $l and $r == $r and $l <= $r"),
    ("!>", "l as $l | r as $r | $l == $l and $r == $r and $l > $r"),
    ("!>=", "l as $l | r as $r | $l == $l and $r == $r and $l >= $r"),
];

/// The definitions of these functions.
pub fn definitions() -> impl Iterator<Item = Def<&'static str>> {
    let define = |(name, body)| {
        let body = jaq_core::load::parse(body, |parser| parser.term())?;
        Some(Def { name, args: vec!["l", "r"], body })
    };
    COMPARISONS.into_iter().filter_map(define)
}

/// Replaces the comparison operators of a program by these functions.
pub fn replace(program: &mut Term<&str>) {
    let all = |terms: &mut [Term<_>]| terms.iter_mut().for_each(replace);
    match program {
        Term::Id | Term::Recurse | Term::Num(_) | Term::Break(_) | Term::Var(_) => {}
        Term::Str(_, parts) => parts.iter_mut().for_each(|part| match part {
            StrPart::Term(term) => replace(term),
            StrPart::Str(_) | StrPart::Char(_) => {}
        }),
        Term::Arr(term) => term.iter_mut().for_each(|term| replace(term)),
        Term::Obj(entries) => entries.iter_mut().for_each(|(key, value)| {
            replace(key);
            value.iter_mut().for_each(replace);
        }),
        Term::Neg(term) | Term::Label(_, term) => replace(term),
        Term::BinOp(left, operator, right) => {
            replace(left);
            replace(right);
            match operator {
                BinaryOp::Pipe(Some(pattern)) => replace_in_pattern(pattern),
                BinaryOp::Cmp(comparison @ (Cmp::Lt | Cmp::Le | Cmp::Gt | Cmp::Ge)) => {
                    let [(lt, _), (le, _), (gt, _), (ge, _)] = COMPARISONS;
                    let name = match comparison {
                        Cmp::Lt => lt,
                        Cmp::Le => le,
                        Cmp::Gt => gt,
                        _ => ge,
                    };
                    *program = Term::Call(name, vec![std::mem::take(left), std::mem::take(right)]);
                }
                _ => {}
            }
        }
        Term::Fold(_, over, pattern, arguments) => {
            replace(over);
            replace_in_pattern(pattern);
            all(arguments);
        }
        Term::TryCatch(term, caught) => {
            replace(term);
            caught.iter_mut().for_each(|term| replace(term));
        }
        Term::IfThenElse(branches, otherwise) => {
            branches.iter_mut().for_each(|(condition, then)| {
                replace(condition);
                replace(then);
            });
            otherwise.iter_mut().for_each(|term| replace(term));
        }
        Term::Def(definitions, term) => {
            definitions.iter_mut().for_each(|definition| replace(&mut definition.body));
            replace(term);
        }
        Term::Call(_, arguments) => all(arguments),
        Term::Path(term, Path(parts)) => {
            replace(term);
            parts.iter_mut().for_each(|(part, _)| match part {
                Part::Index(index) => replace(index),
                Part::Range(from, to) => from.iter_mut().chain(to).for_each(replace),
            });
        }
    }
}

fn replace_in_pattern(pattern: &mut Pattern<&str>) {
    match pattern {
        Pattern::Var(_) => {}
        Pattern::Arr(patterns) => patterns.iter_mut().for_each(replace_in_pattern),
        Pattern::Obj(entries) => entries.iter_mut().for_each(|(key, pattern)| {
            replace(key);
            replace_in_pattern(pattern);
        }),
    }
}
