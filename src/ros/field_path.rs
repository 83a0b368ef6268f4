//! Which field of a message could not be read.
//!
//! CDR does not name its fields, but a struct that reads itself tells their names in advance.
//! A traced deserializer notes them on the way out of an error, and costs nothing without one.

use std::cell::RefCell;
use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, SeqAccess, Visitor};
use serde::forward_to_deserialize_any;

/// The way from the message to one of its fields, as `header.stamp.sec` or `ranges[12]`.
#[derive(Debug, Default)]
pub(super) struct FieldPath {
    /// Innermost first.
    steps: RefCell<Vec<Step>>,
}

#[derive(Debug, Clone, Copy)]
enum Step {
    Field(&'static str),
    Element(usize),
}

impl FieldPath {
    /// `inner`, which notes here in which field it fails.
    pub(super) const fn traced<D>(&self, inner: D) -> Traced<'_, D> {
        Traced { inner, names: &[], path: &self.steps }
    }
}

impl fmt::Display for FieldPath {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (position, step) in self.steps.borrow().iter().rev().enumerate() {
            match step {
                Step::Field(name) if position == 0 => formatter.write_str(name)?,
                Step::Field(name) => write!(formatter, ".{name}")?,
                Step::Element(index) => write!(formatter, "[{index}]")?,
            }
        }
        Ok(())
    }
}

/// A deserializer, or a part of one, that notes where it fails.
pub(super) struct Traced<'p, T> {
    inner: T,
    /// Names of the fields of the struct that is read; empty for a sequence.
    names: &'static [&'static str],
    path: &'p RefCell<Vec<Step>>,
}

macro_rules! pass_on {
    ($($method:ident)*) => {$(
        fn $method<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, D::Error> {
            self.inner.$method(visitor)
        }
    )*};
}

impl<'de, D: Deserializer<'de>> Deserializer<'de> for Traced<'_, D> {
    type Error = D::Error;

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        let visitor = Traced { inner: visitor, names: fields, path: self.path };
        self.inner.deserialize_struct(name, fields, visitor)
    }

    fn deserialize_seq<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, D::Error> {
        let visitor = Traced { inner: visitor, names: &[], path: self.path };
        self.inner.deserialize_seq(visitor)
    }

    fn deserialize_tuple<V: Visitor<'de>>(
        self,
        len: usize,
        visitor: V,
    ) -> Result<V::Value, D::Error> {
        let visitor = Traced { inner: visitor, names: &[], path: self.path };
        self.inner.deserialize_tuple(len, visitor)
    }

    // The kinds of fields that messages have; for all others the format is asked.
    pass_on! {
        deserialize_any deserialize_u8 deserialize_i32 deserialize_u32 deserialize_f32
        deserialize_f64 deserialize_string deserialize_byte_buf
    }

    forward_to_deserialize_any! {
        bool i8 i16 i64 i128 u16 u64 u128 char str bytes option unit unit_struct newtype_struct
        tuple_struct map enum identifier ignored_any
    }

    fn is_human_readable(&self) -> bool {
        self.inner.is_human_readable()
    }
}

impl<'de, V: Visitor<'de>> Visitor<'de> for Traced<'_, V> {
    type Value = V::Value;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.inner.expecting(formatter)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, seq: A) -> Result<V::Value, A::Error> {
        let elements = Elements { inner: seq, next: 0, names: self.names, path: self.path };
        self.inner.visit_seq(elements)
    }
}

struct Elements<'p, A> {
    inner: A,
    next: usize,
    names: &'static [&'static str],
    path: &'p RefCell<Vec<Step>>,
}

impl<'de, A: SeqAccess<'de>> SeqAccess<'de> for Elements<'_, A> {
    type Error = A::Error;

    fn next_element_seed<S: DeserializeSeed<'de>>(
        &mut self,
        seed: S,
    ) -> Result<Option<S::Value>, A::Error> {
        let index = self.next;
        self.next += 1;
        let seed = Traced { inner: seed, names: &[], path: self.path };
        self.inner.next_element_seed(seed).inspect_err(|_| {
            let step =
                self.names.get(index).map_or(Step::Element(index), |&name| Step::Field(name));
            self.path.borrow_mut().push(step);
        })
    }
}

impl<'de, S: DeserializeSeed<'de>> DeserializeSeed<'de> for Traced<'_, S> {
    type Value = S::Value;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<S::Value, D::Error> {
        self.inner.deserialize(Traced { inner: deserializer, names: self.names, path: self.path })
    }
}
