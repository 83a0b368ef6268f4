//! Kinds of fields that serde's derive does not write as ROS does.

use std::fmt;

use serde::de::{Error as _, SeqAccess, Unexpected, Visitor};
use serde::ser::SerializeTuple as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// `float64[36]`: a 6 by 6 covariance, row by row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Covariance(pub [f64; 36]);

impl Default for Covariance {
    fn default() -> Self {
        Self([0.0; 36])
    }
}

impl Serialize for Covariance {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut tuple = serializer.serialize_tuple(36)?;
        for element in &self.0 {
            tuple.serialize_element(element)?;
        }
        tuple.end()
    }
}

impl<'de> Deserialize<'de> for Covariance {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_tuple(36, CovarianceVisitor)
    }
}

struct CovarianceVisitor;

impl<'de> Visitor<'de> for CovarianceVisitor {
    type Value = Covariance;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("an array of 36 numbers")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<Covariance, A::Error> {
        let mut covariance = Covariance::default();
        for (index, element) in covariance.0.iter_mut().enumerate() {
            *element = seq.next_element()?.ok_or_else(|| A::Error::invalid_length(index, &self))?;
        }
        Ok(covariance)
    }
}

/// `int8[]`, copied as a whole where serde would go element by element.
#[derive(Clone, Default, PartialEq, Eq)]
pub struct Int8Array {
    /// The elements in two's complement.
    octets: Vec<u8>,
}

impl Int8Array {
    /// The elements.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = i8> {
        self.octets.iter().map(|&octet| octet as i8)
    }

    /// How many elements there are.
    #[must_use]
    pub const fn len(&self) -> usize {
        self.octets.len()
    }

    /// Whether there is no element.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.octets.is_empty()
    }
}

impl From<&[i8]> for Int8Array {
    fn from(elements: &[i8]) -> Self {
        Self { octets: elements.iter().map(|&element| element as u8).collect() }
    }
}

impl fmt::Debug for Int8Array {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} int8", self.len())
    }
}

impl Serialize for Int8Array {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if serializer.is_human_readable() {
            serializer.collect_seq(self.iter())
        } else {
            serializer.serialize_bytes(&self.octets)
        }
    }
}

impl<'de> Deserialize<'de> for Int8Array {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        if deserializer.is_human_readable() {
            Vec::<i8>::deserialize(deserializer).map(|elements| Self::from(elements.as_slice()))
        } else {
            deserializer.deserialize_byte_buf(OctetsVisitor).map(|octets| Self { octets })
        }
    }
}

struct OctetsVisitor;

impl Visitor<'_> for OctetsVisitor {
    type Value = Vec<u8>;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("an array of int8")
    }

    fn visit_byte_buf<E>(self, octets: Vec<u8>) -> Result<Vec<u8>, E> {
        Ok(octets)
    }
}

/// A float that JSON, which has no NaN and no infinity, may also say by name.
struct Float(f32);

impl Serialize for Float {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self.0 {
            f32::INFINITY => serializer.serialize_str("inf"),
            f32::NEG_INFINITY => serializer.serialize_str("-inf"),
            value => serializer.serialize_f32(value),
        }
    }
}

impl<'de> Deserialize<'de> for Float {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(FloatVisitor).map(Float)
    }
}

struct FloatVisitor;

impl Visitor<'_> for FloatVisitor {
    type Value = f32;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("a number, null, \"nan\", \"inf\" or \"-inf\"")
    }

    fn visit_f64<E>(self, value: f64) -> Result<f32, E> {
        Ok(value as f32)
    }

    fn visit_i64<E>(self, value: i64) -> Result<f32, E> {
        Ok(value as f32)
    }

    fn visit_u64<E>(self, value: u64) -> Result<f32, E> {
        Ok(value as f32)
    }

    fn visit_unit<E>(self) -> Result<f32, E> {
        Ok(f32::NAN)
    }

    fn visit_str<E: serde::de::Error>(self, name: &str) -> Result<f32, E> {
        match name {
            "nan" => Ok(f32::NAN),
            "inf" => Ok(f32::INFINITY),
            "-inf" => Ok(f32::NEG_INFINITY),
            _ => Err(E::invalid_value(Unexpected::Str(name), &self)),
        }
    }
}

/// `float32` for `#[serde(with)]`.
pub(super) mod float {
    use super::{Deserialize as _, Deserializer, Float, Serialize as _, Serializer};

    pub(in super::super) fn serialize<S: Serializer>(
        value: &f32,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        if serializer.is_human_readable() {
            Float(*value).serialize(serializer)
        } else {
            value.serialize(serializer)
        }
    }

    pub(in super::super) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<f32, D::Error> {
        if deserializer.is_human_readable() {
            Float::deserialize(deserializer).map(|float| float.0)
        } else {
            f32::deserialize(deserializer)
        }
    }
}

/// `float32[]` for `#[serde(with)]`.
pub(super) mod floats {
    use super::{Deserialize as _, Deserializer, Float, Serialize as _, Serializer};

    pub(in super::super) fn serialize<S: Serializer>(
        values: &[f32],
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        if serializer.is_human_readable() {
            serializer.collect_seq(values.iter().map(|&value| Float(value)))
        } else {
            values.serialize(serializer)
        }
    }

    pub(in super::super) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<Vec<f32>, D::Error> {
        if deserializer.is_human_readable() {
            let floats = Vec::<Float>::deserialize(deserializer)?;
            Ok(floats.into_iter().map(|float| float.0).collect())
        } else {
            Vec::deserialize(deserializer)
        }
    }
}
