//! The keys of one robot.

use thiserror::Error;
use zenoh::key_expr::{KeyExpr, OwnedKeyExpr};

use super::input::Input;
use crate::config::Keys;

/// What every key of a robot begins with.
///
/// May be empty: then the robot's keys are `scan`, `map` and so on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Prefix(Option<OwnedKeyExpr>);

/// Why a key cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum KeyError {
    /// Zenoh does not take it.
    #[error("{key:?} is no key: {reason}")]
    Invalid {
        /// What was given.
        key: String,
        /// What Zenoh says.
        reason: String,
    },
    /// It stands for many keys.
    #[error("{0:?} has a wildcard; the keys of one robot are needed, as in robot01")]
    Wildcard(String),
    /// ROS 2 could not name it.
    #[error(
        "{0:?} is no ROS 2 name, which interop: rmw_zenoh needs: words of letters, digits and _, \
         with / between"
    )]
    NotRosName(String),
}

impl Prefix {
    /// Parses what the user gave; slashes at either end do not matter.
    ///
    /// # Errors
    /// When it is not part of a key or has wildcards.
    pub fn parse(text: &str) -> Result<Self, KeyError> {
        let text = text.trim_matches('/');
        if text.is_empty() { Ok(Self(None)) } else { Ok(Self(Some(literal_key(text)?))) }
    }

    /// A key of the robot: `name` under the prefix, such as `map` or `slam/status`.
    ///
    /// # Errors
    /// When `name` is not part of a key or has wildcards.
    pub fn key(&self, name: &str) -> Result<OwnedKeyExpr, KeyError> {
        match &self.0 {
            Some(prefix) => literal_key(&format!("{prefix}/{name}")),
            None => literal_key(name),
        }
    }
}

impl std::fmt::Display for Prefix {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.as_ref().map_or(Ok(()), |prefix| prefix.fmt(formatter))
    }
}

/// The keys that the daemon listens to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputKeys {
    /// Of the scans, of what tells motion, and of the transforms that move and that do not.
    keys: [OwnedKeyExpr; 4],
    motion: Input,
}

impl InputKeys {
    /// The inputs with the keys that `key` gives them; `motion` is [`Input::Pose`], or odometry.
    ///
    /// # Errors
    /// When `key` has none for one of them.
    pub fn of_inputs(
        motion: Input,
        key: impl FnMut(Input) -> Result<OwnedKeyExpr, KeyError>,
    ) -> Result<Self, KeyError> {
        let [scan, moves, tf, tf_static] =
            [Input::Scan, motion, Input::Tf, Input::TfStatic].map(key);
        Ok(Self { keys: [scan?, moves?, tf?, tf_static?], motion })
    }

    /// The configured names under the prefix, as they are without ROS 2's own keys.
    ///
    /// # Errors
    /// When one of them is not part of a key or has wildcards.
    pub fn under(prefix: &Prefix, names: &Keys) -> Result<Self, KeyError> {
        Self::of_inputs(Input::Odom, |input| prefix.key(input.key_in(names)))
    }

    /// Whole keys, as a daemon tells them; by ROS 2's own convention they end with a wildcard.
    ///
    /// # Errors
    /// When one of them is no key.
    pub fn parse(motion: Input, mut key: impl FnMut(Input) -> String) -> Result<Self, KeyError> {
        Self::of_inputs(motion, |input| key_expression(key(input)))
    }

    /// What is listened to.
    #[must_use]
    pub const fn inputs(&self) -> [Input; 4] {
        [Input::Scan, self.motion, Input::Tf, Input::TfStatic]
    }

    /// Where messages say how the base moves: [`Input::Odom`] or [`Input::Pose`].
    #[must_use]
    pub const fn motion(&self) -> Input {
        self.motion
    }

    /// The key of an input; odometry and given poses stand for each other.
    #[must_use]
    pub const fn of(&self, input: Input) -> &OwnedKeyExpr {
        let [scan, motion, tf, tf_static] = &self.keys;
        match input {
            Input::Scan => scan,
            Input::Odom | Input::Pose => motion,
            Input::Tf => tf,
            Input::TfStatic => tf_static,
        }
    }
}

fn literal_key(text: &str) -> Result<OwnedKeyExpr, KeyError> {
    // Zenoh would call `robot*` malformed, and say no word of wildcards.
    if text.contains('*') {
        return Err(KeyError::Wildcard(text.to_owned()));
    }
    key_expression(text.to_owned())
}

/// A key, or many with wildcards.
pub(super) fn key_expression(text: String) -> Result<OwnedKeyExpr, KeyError> {
    match KeyExpr::autocanonize(text.clone()) {
        Ok(key) => Ok(key.into()),
        Err(error) => Err(KeyError::Invalid { key: text, reason: plain_message(&error) }),
    }
}

/// What Zenoh says is wrong, without the places in its sources where it noticed.
#[must_use]
pub fn plain_message(error: &zenoh::Error) -> String {
    without_places(&error.to_string())
}

/// Zenoh writes places as in ` at /path/to/file.rs:12.`
fn without_places(text: &str) -> String {
    let mut plain = String::new();
    let mut rest = text;
    while let Some((before, place)) = rest.split_once(" at /") {
        plain.push_str(before);
        let after = place.split_once(".rs:").map_or("", |(_, after)| after);
        rest = after.trim_start_matches(|c: char| c.is_ascii_digit());
        rest = rest.strip_prefix('.').unwrap_or(rest);
    }
    plain.push_str(rest);
    plain.trim_end_matches(['!', ' ', '.']).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_do_not_say_where_in_the_sources_they_arose() {
        let text = "Can not bind: [Cannot assign at all at /a/src/tcp.rs:61.] at /b/lib.rs:338.";
        assert_eq!(without_places(text), "Can not bind: [Cannot assign at all]");
        assert_eq!(without_places("Unable to connect! "), "Unable to connect");
    }

    #[test]
    fn keys_are_under_the_prefix() {
        let key = |prefix: &str, name: &str| {
            Prefix::parse(prefix).and_then(|prefix| prefix.key(name)).map(|key| key.to_string())
        };
        assert_eq!(key("robot01", "map").unwrap(), "robot01/map");
        assert_eq!(key("/site/robot01/", "slam/status").unwrap(), "site/robot01/slam/status");
        assert_eq!(key("", "scan").unwrap(), "scan");
        assert_eq!(key("robot*", "map"), Err(KeyError::Wildcard("robot*".to_owned())));
        let error = key("robot01", "a//b").unwrap_err().to_string();
        assert!(
            error.starts_with("\"robot01/a//b\" is no key: ") && !error.contains(".rs"),
            "{error}"
        );
    }
}
