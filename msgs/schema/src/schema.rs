// SPDX-License-Identifier: MIT OR Apache-2.0
//! A type together with all types it consists of.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use crate::error::{MAX_DEPTH, MAX_SIZE, MAX_VALUES};
use crate::{
    Base, Definition, Fault, Field, HashedTypeDescription, IndividualTypeDescription, NamedHash, SchemaError,
    Shape, TypeDescription, TypeHash, TypeName, bundle, well_known,
};

/// Returns a type's definition; `None` if there is none.
pub type Lookup<'a> = dyn FnMut(&TypeName) -> Result<Option<Arc<Definition>>, SchemaError> + 'a;

/// A type and all types it consists of, which decoding, hashing and code generation need. Its types are known to
/// exist, not to be recursive, and to be of a size that can be handled.
#[derive(Clone, Debug)]
pub struct Schema {
    /// The type itself, then the others in the order of their names.
    types: Vec<Node>,
    hash: TypeHash,
}

/// One type of a schema.
#[derive(Clone, Debug)]
pub(crate) struct Node {
    pub definition: Arc<Definition>,
    /// For each field the type of its elements, if that is a message.
    pub nested: Vec<Option<usize>>,
    /// The least size of a value in CDR: the sum of the smallest sizes of its fields, without padding.
    pub min_size: usize,
}

impl Schema {
    /// Parses a type and those it consists of from one text: the definition, then for each further type a line of `=`,
    /// a line `MSG: package/Name` and its definition. This is the text `ros2msg` of rosbag2 and MCAP.
    ///
    /// # Errors
    /// [`SchemaError`] if the text is not valid or a type is missing.
    pub fn from_text(name: &TypeName, text: &str) -> Result<Self, SchemaError> {
        let definitions = bundle::parse(name, text)?;
        Self::resolve(name, &mut |name| match definitions.get(name) {
            Some(definition) => Ok(Some(definition.clone())),
            None => Ok(well_known::definition(name)?.map(Arc::new)),
        })
        .map_err(|error| error.searched("the text"))
    }

    /// The schema that a type description describes. Constants and comments are no part of descriptions.
    ///
    /// # Errors
    /// [`SchemaError`] if the description is not valid or a type is missing.
    pub fn from_description(description: &TypeDescription) -> Result<Self, SchemaError> {
        let (name, definitions) = description.definitions()?;
        Self::resolve(&name, &mut |name| Ok(definitions.get(name).cloned()))
            .map_err(|error| error.searched("the type description"))
    }

    /// Looks up a type and all types it consists of.
    ///
    /// # Errors
    /// [`SchemaError`] if a type is missing, recursive or too large; an error of `lookup`.
    pub fn resolve(name: &TypeName, lookup: &mut Lookup<'_>) -> Result<Self, SchemaError> {
        let missing = || SchemaError::Missing { name: name.to_string(), searched: String::new() };
        let definition = lookup(name)?.ok_or_else(missing)?;
        let mut resolver = Resolver { lookup, done: BTreeMap::new(), path: vec![] };
        resolver.visit(definition)?;
        let mut done = resolver.done;
        let root = done.remove(name).ok_or_else(missing)?;
        let types: Vec<_> = std::iter::once(root).chain(done.into_values()).collect();
        let index: HashMap<_, _> = types.iter().map(|ty| ty.definition.name.clone()).zip(0..).collect();
        let node = |ty: Measured| {
            let nested = ty.definition.fields.iter().map(|field| match &field.ty.base {
                Base::Nested(name) => index.get(name).copied(),
                _ => None,
            });
            let nested = nested.collect();
            Node { nested, min_size: ty.size as usize, definition: ty.definition }
        };
        let mut schema = Self { types: types.into_iter().map(node).collect(), hash: TypeHash::of("") };
        schema.hash = TypeDescription::from(&schema).hash();
        Ok(schema)
    }

    /// The schema of one of the types that it consists of.
    ///
    /// # Errors
    /// [`SchemaError::Missing`] if the type does not consist of that one.
    pub fn of_part(&self, name: &TypeName) -> Result<Self, SchemaError> {
        let definitions = self.types.iter().map(|node| &node.definition);
        Self::resolve(name, &mut |name| {
            Ok(definitions.clone().find(|definition| definition.name == *name).cloned())
        })
        .map_err(|error| error.searched(self.name().as_str()))
    }

    /// The type's name.
    pub fn name(&self) -> &TypeName {
        &self.definition().name
    }

    /// The type's definition.
    pub fn definition(&self) -> &Definition {
        &self.types[0].definition
    }

    /// The definitions of the types it consists of, itself left out, in the order of their names.
    pub fn referenced(&self) -> impl Iterator<Item = &Definition> {
        self.types[1..].iter().map(|node| &*node.definition)
    }

    /// The hash of the type.
    pub fn hash(&self) -> TypeHash {
        self.hash
    }

    /// The type and those it consists of as one text, which [`from_text`](Self::from_text) reads. Normalised: without
    /// comments, constants first.
    pub fn to_text(&self) -> String {
        bundle::write(self.definition(), self.referenced())
    }

    /// Type `index` of the schema; 0 is the type itself.
    pub(crate) fn node(&self, index: usize) -> &Node {
        &self.types[index]
    }

    /// Every type's index.
    pub(crate) fn indices(&self) -> std::ops::Range<usize> {
        0..self.types.len()
    }

    /// The types that type `start` consists of, itself left out, in the order of their names.
    pub(crate) fn reachable(&self, start: usize) -> Vec<usize> {
        let mut reached = vec![false; self.types.len()];
        let mut pending = vec![start];
        while let Some(index) = pending.pop() {
            for &nested in self.types[index].nested.iter().flatten() {
                if !std::mem::replace(&mut reached[nested], true) {
                    pending.push(nested);
                }
            }
        }
        let mut reached: Vec<_> = self.indices().filter(|&index| reached[index] && index != start).collect();
        reached.sort_by_key(|&index| &self.types[index].definition.name);
        reached
    }
}

impl TypeDescription {
    /// The description of type `index` of a schema.
    fn of(schema: &Schema, index: usize) -> Self {
        let describe = |index: usize| IndividualTypeDescription::from(&*schema.node(index).definition);
        Self {
            type_description: describe(index),
            referenced_type_descriptions: schema.reachable(index).into_iter().map(describe).collect(),
        }
    }
}

impl From<&Schema> for TypeDescription {
    fn from(schema: &Schema) -> Self {
        Self::of(schema, 0)
    }
}

impl From<&Schema> for HashedTypeDescription {
    fn from(schema: &Schema) -> Self {
        let indices = std::iter::once(0).chain(schema.reachable(0));
        let type_hashes = indices.map(|index| NamedHash {
            type_name: schema.node(index).definition.name.to_string(),
            hash_string: TypeDescription::of(schema, index).hash().to_string(),
        });
        Self { type_description_msg: TypeDescription::of(schema, 0), type_hashes: type_hashes.collect() }
    }
}

/// A type whose nested types are all known.
struct Measured {
    definition: Arc<Definition>,
    size: u64,
    values: u64,
    height: usize,
}

/// Depth-first through the types.
struct Resolver<'a, 'b> {
    lookup: &'a mut Lookup<'b>,
    done: BTreeMap<TypeName, Measured>,
    path: Vec<TypeName>,
}

impl Resolver<'_, '_> {
    fn visit(&mut self, definition: Arc<Definition>) -> Result<(), SchemaError> {
        self.path.push(definition.name.clone());
        let mut measured = Measured { definition: definition.clone(), size: 0, values: 1, height: 1 };
        for field in &definition.fields {
            let (size, values) = match &field.ty.base {
                Base::Nested(name) => {
                    self.visit_field(field, name)?;
                    let nested = &self.done[name];
                    measured.height = measured.height.max(nested.height + 1);
                    (nested.size, nested.values)
                }
                Base::Primitive(primitive) => (primitive.size() as u64, 0),
                Base::String { .. } | Base::WString { .. } => (4, 1),
            };
            let (size, values) = match field.ty.shape {
                Shape::Single => (size, values),
                Shape::Array(len) => (size.saturating_mul(len.into()), values.saturating_mul(len.into())),
                Shape::Bounded(_) | Shape::Unbounded => (4, 0),
            };
            measured.size = measured.size.saturating_add(size);
            measured.values = measured.values.saturating_add(values).saturating_add(1);
        }
        if measured.size > MAX_SIZE || measured.values > MAX_VALUES {
            return Err(SchemaError::TooLarge { name: definition.name.to_string() });
        }
        self.path.pop();
        self.done.insert(definition.name.clone(), measured);
        Ok(())
    }

    /// Visits the type of a field, unless it was visited before.
    fn visit_field(&mut self, field: &Field, name: &TypeName) -> Result<(), SchemaError> {
        let error = |fault| Err(SchemaError::Definition { place: field.place.clone(), fault });
        if let Some(start) = self.path.iter().position(|other| other == name) {
            let chain: Vec<_> = self.path[start..].iter().chain([name]).map(TypeName::as_str).collect();
            return error(Fault::Recursive { chain: chain.join(" > ") });
        }
        if !self.done.contains_key(name) {
            if self.path.len() == MAX_DEPTH {
                return error(Fault::TooDeep);
            }
            match (self.lookup)(name)? {
                Some(definition) => self.visit(definition)?,
                None => return error(Fault::Unknown { name: name.to_string(), searched: String::new() }),
            }
        }
        if self.path.len() + self.done[name].height > MAX_DEPTH { error(Fault::TooDeep) } else { Ok(()) }
    }
}

impl SchemaError {
    /// Adds where a missing type was searched for.
    pub(crate) fn searched(self, place: &str) -> Self {
        let searched = place.to_owned();
        match self {
            Self::Missing { name, searched: old } if old.is_empty() => Self::Missing { name, searched },
            Self::Definition { place, fault: Fault::Unknown { name, searched: old } } if old.is_empty() => {
                Self::Definition { place, fault: Fault::Unknown { name, searched } }
            }
            other => other,
        }
    }
}
