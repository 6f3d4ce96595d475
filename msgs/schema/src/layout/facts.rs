// SPDX-License-Identifier: MIT OR Apache-2.0
//! The facts from which the layouts of a schema's types are computed.

use super::plain::{NotPlain, Plain};
use super::position::Position;
use crate::{Base, FieldType, Schema, Shape};

/// The facts about each type of a schema.
pub struct Facts<'a> {
    schema: &'a Schema,
    pub plain: Vec<Result<Plain, NotPlain>>,
    /// For a fixed type: the bytes from a start, given modulo 8, to the end of its last primitive, padding before
    /// the first included.
    spans: Vec<Option<[usize; 8]>>,
    first_align: Vec<usize>,
    max_align: Vec<usize>,
}

impl<'a> Facts<'a> {
    pub fn of(schema: &'a Schema) -> Self {
        let count = schema.indices().len();
        let empty = || Err(NotPlain::Variable { field: String::new() });
        let mut facts = Self {
            schema,
            plain: (0..count).map(|_| empty()).collect(),
            spans: vec![None; count],
            first_align: vec![0; count],
            max_align: vec![1; count],
        };
        facts.visit(0);
        facts
    }

    /// Children first. The depth of schemas is limited.
    fn visit(&mut self, index: usize) {
        if self.first_align[index] != 0 {
            return;
        }
        for &nested in self.schema.node(index).nested.iter().flatten() {
            self.visit(nested);
        }
        let node = self.schema.node(index);
        let fields = || node.definition.fields.iter().zip(&node.nested);
        self.max_align[index] =
            fields().map(|(field, nested)| self.max_align(&field.ty, *nested)).max().unwrap_or(1);
        self.first_align[index] =
            fields().next().map_or(1, |(field, nested)| self.first_align(&field.ty, *nested));
        let mut spans = [0; 8];
        let mut fixed = true;
        for (start, span) in spans.iter_mut().enumerate() {
            for (field, nested) in fields() {
                match self.span(&field.ty, *nested, (start + *span) % 8) {
                    Some(bytes) => *span += bytes,
                    None => fixed = false,
                }
            }
        }
        self.spans[index] = fixed.then_some(spans);
        self.plain[index] = self.plain_struct(index);
    }

    fn plain_struct(&self, index: usize) -> Result<Plain, NotPlain> {
        let node = self.schema.node(index);
        let mut whole = Plain { size: 0, align: 1, cdr_size: 0, first_align: self.first_align[index] };
        for (field, nested) in node.definition.fields.iter().zip(&node.nested) {
            let plain = self.plain_field(&field.ty, *nested, &field.name)?;
            let in_c = whole.size.next_multiple_of(plain.align);
            let in_cdr = whole.cdr_size.next_multiple_of(plain.first_align);
            if in_c != in_cdr {
                return Err(NotPlain::Misplaced { field: field.name.clone(), in_c, in_cdr });
            }
            whole.size = in_c + plain.size;
            whole.cdr_size = in_cdr + plain.cdr_size;
            whole.align = whole.align.max(plain.align);
        }
        whole.size = whole.size.next_multiple_of(whole.align);
        Ok(whole)
    }

    fn plain_field(&self, ty: &FieldType, nested: Option<usize>, name: &str) -> Result<Plain, NotPlain> {
        let element = match (&ty.base, nested) {
            (Base::Primitive(primitive), _) => {
                let size = primitive.size();
                Plain { size, align: size, cdr_size: size, first_align: size }
            }
            (Base::Nested(_), Some(nested)) => {
                self.plain[nested].clone().map_err(|reason| reason.inside(name))?
            }
            _ => return Err(NotPlain::Variable { field: name.to_owned() }),
        };
        match ty.shape {
            Shape::Single => Ok(element),
            Shape::Array(len) => {
                if len > 1 && element.cdr_size.next_multiple_of(element.first_align) != element.size {
                    return Err(NotPlain::Array { field: name.to_owned() });
                }
                let before = (len as usize - 1) * element.size;
                Ok(Plain { size: before + element.size, cdr_size: before + element.cdr_size, ..element })
            }
            Shape::Bounded(_) | Shape::Unbounded => Err(NotPlain::Variable { field: name.to_owned() }),
        }
    }

    pub fn first_align(&self, ty: &FieldType, nested: Option<usize>) -> usize {
        match (ty.shape, &ty.base, nested) {
            (Shape::Bounded(_) | Shape::Unbounded, ..) => 4,
            (_, Base::Primitive(primitive), _) => primitive.size(),
            (_, _, Some(nested)) => self.first_align[nested],
            _ => 4,
        }
    }

    fn max_align(&self, ty: &FieldType, nested: Option<usize>) -> usize {
        match (&ty.base, nested) {
            (Base::Primitive(primitive), _) => primitive.size(),
            (_, Some(nested)) => self.max_align[nested],
            _ => 4,
        }
    }

    /// The bytes that a fixed field takes at a start, given modulo 8.
    fn span(&self, ty: &FieldType, nested: Option<usize>, start: usize) -> Option<usize> {
        let element = |start: usize| match (&ty.base, nested) {
            (Base::Primitive(primitive), _) => {
                Some(start.next_multiple_of(primitive.size()) - start + primitive.size())
            }
            (_, Some(nested)) => Some(self.spans[nested]?[start % 8]),
            _ => None,
        };
        let len = match ty.shape {
            Shape::Single => 1,
            Shape::Array(len) => len as usize,
            Shape::Bounded(_) | Shape::Unbounded => return None,
        };
        // Starts modulo 8 repeat: at most 8 elements are looked at, the rest is a multiple of one period.
        let (mut at, mut seen, mut index) = (start, [None; 8], 0);
        while index < len {
            if let Some((first, first_at)) = seen[at % 8].replace((index, at)) {
                let (period, bytes): (usize, usize) = (index - first, at - first_at);
                let repeats = (len - index) / period;
                at += repeats * bytes;
                index += repeats * period;
                seen = [None; 8];
                if repeats > 0 {
                    continue;
                }
            }
            at += element(at)?;
            index += 1;
        }
        Some(at - start)
    }

    /// Moves past a field.
    pub fn advance(&self, position: &mut Position, ty: &FieldType, nested: Option<usize>, path: &str) {
        position.align(self.first_align(ty, nested));
        if position.multiple >= self.max_align(ty, nested)
            && let Some(bytes) = self.span(ty, nested, position.residue)
        {
            return position.add(bytes);
        }
        match (ty.shape, &ty.base, nested) {
            (Shape::Single, Base::String { .. }, _) => {
                position.add(5);
                position.variable(&format!("|{path}|"), 1);
            }
            (Shape::Single, Base::WString { .. }, _) => {
                position.add(4);
                position.variable(&format!("4·|{path}|"), 4);
            }
            (Shape::Single, Base::Nested(_), Some(nested)) => {
                let node = self.schema.node(nested);
                for (field, inner) in node.definition.fields.iter().zip(&node.nested) {
                    self.advance(position, &field.ty, *inner, &format!("{path}.{}", field.name));
                }
            }
            (Shape::Bounded(_) | Shape::Unbounded, Base::Primitive(primitive), _) => {
                let size = primitive.size();
                position.add(4);
                position.align(size);
                let times = if size == 1 { String::new() } else { format!("{size}·") };
                position.variable(&format!("{times}|{path}|"), size.min(4));
            }
            (Shape::Bounded(_) | Shape::Unbounded, ..) => {
                position.add(4);
                position.variable(&format!("bytes({path})"), 1);
            }
            // The elements differ in size or in padding.
            _ => position.variable(&format!("bytes({path})"), 1),
        }
    }
}
