//! The daemon as a node of ROS 2: the keys of its topics and services, and what it announces.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use sha2::{Digest as _, Sha256};
use zenoh::Session;
use zenoh::bytes::Encoding;
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::liveliness::LivelinessToken;

use super::input::Input;
use super::keys::{InputKeys, KeyError, Prefix, key_expression};
use super::serving::ServingError;
use crate::clock;
use crate::config::{Interop, Keys, RawConfig, RosDistro};
use crate::ros::graph::rmw_zenoh::{Attachment, Graph, Node, TypeHashes};
use crate::ros::graph::{Endpoint, Qos, Role, WireType, ros2dds};

/// What the daemon is called in the graph.
const NAME: &str = "gmapd";

/// How ROS 2 nodes are met.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Convention {
    /// Not at all: nothing is announced.
    Silent,
    /// Through `zenoh-bridge-ros2dds`, which takes keys and messages as they are.
    Bridge,
    /// They are on the same mesh, by `rmw_zenoh`.
    RmwZenoh(Graph),
}

impl Convention {
    /// What the configuration says.
    #[must_use]
    pub const fn new(config: &RawConfig) -> Self {
        let hashes = match config.ros_distro {
            RosDistro::Jazzy => TypeHashes::Known,
            RosDistro::Humble => TypeHashes::Unknown,
        };
        match config.interop {
            Interop::None => Self::Silent,
            Interop::Bridge => Self::Bridge,
            Interop::RmwZenoh => Self::RmwZenoh(Graph { domain: config.ros_domain_id, hashes }),
        }
    }
}

/// The node, with the endpoints it has so far.
#[derive(Debug)]
pub struct RosNode {
    prefix: Prefix,
    convention: Convention,
    node: Node,
    endpoints: Vec<Endpoint>,
}

/// What a publisher of ROS messages is declared with.
#[derive(Debug)]
pub(super) struct Output {
    pub(super) key: OwnedKeyExpr,
    pub(super) encoding: Encoding,
    pub(super) signature: Signature,
}

/// What a publisher signs its messages with, where ROS 2 nodes want that.
#[derive(Debug, Clone, Default)]
pub(super) struct Signature(Option<Arc<Signer>>);

#[derive(Debug)]
struct Signer {
    gid: [u8; 16],
    sent: AtomicI64,
}

impl RosNode {
    /// A node without endpoints on the session with this id.
    #[must_use]
    pub fn new(session: String, prefix: Prefix, convention: Convention) -> Self {
        let node = Node { session, namespace: prefix.to_string(), name: NAME };
        Self { prefix, convention, node, endpoints: Vec::new() }
    }

    /// What the robot's keys begin with.
    #[must_use]
    pub const fn prefix(&self) -> &Prefix {
        &self.prefix
    }

    /// Adds the subscriptions to the inputs; returns the keys to listen to.
    ///
    /// # Errors
    /// When a name is not part of a key, or of a ROS name where ROS 2 nodes are to know it.
    pub fn inputs(&mut self, names: &Keys, motion: Input) -> Result<InputKeys, KeyError> {
        InputKeys::of_inputs(motion, |input| self.input(input, names))
    }

    fn input(&mut self, input: Input, names: &Keys) -> Result<OwnedKeyExpr, KeyError> {
        let (wire_type, qos) = (input.wire_type(), input.qos());
        let name = self.add(Role::Subscription, input.key_in(names), wire_type, qos)?;
        match self.convention {
            Convention::Silent | Convention::Bridge => Ok(name),
            Convention::RmwZenoh(graph) => key_expression(graph.subscription_key(&name, wire_type)),
        }
    }

    /// Adds a publisher.
    pub(super) fn output(
        &mut self,
        name: &str,
        wire_type: WireType,
        qos: Qos,
    ) -> Result<Output, KeyError> {
        let name = self.add(Role::Publisher, name, wire_type, qos)?;
        let encoding = Encoding::APPLICATION_CDR.with_schema(wire_type.name);
        match self.convention {
            Convention::Silent | Convention::Bridge => {
                Ok(Output { key: name, encoding, signature: Signature::default() })
            }
            Convention::RmwZenoh(graph) => {
                let key = key_expression(graph.key(&name, wire_type))?;
                let token = self.tokens().pop().unwrap_or_default();
                Ok(Output { key, encoding, signature: Signature::of(&token) })
            }
        }
    }

    /// Adds a service; returns the key it has beside that under the prefix, if it has one.
    pub(super) fn service(
        &mut self,
        name: &str,
        wire_type: WireType,
    ) -> Result<Option<OwnedKeyExpr>, KeyError> {
        let name = self.add(Role::Service, name, wire_type, Qos::SERVICE)?;
        match self.convention {
            Convention::Silent | Convention::Bridge => Ok(None),
            Convention::RmwZenoh(graph) => key_expression(graph.key(&name, wire_type)).map(Some),
        }
    }

    /// Notes an endpoint; returns its name with the prefix.
    fn add(
        &mut self,
        role: Role,
        name: &str,
        wire_type: WireType,
        qos: Qos,
    ) -> Result<OwnedKeyExpr, KeyError> {
        let name = self.prefix.key(name)?;
        if matches!(self.convention, Convention::RmwZenoh(_)) && !is_ros_name(&name) {
            return Err(KeyError::NotRosName(name.to_string()));
        }
        self.endpoints.push(Endpoint { role, name: name.to_string(), wire_type, qos });
        Ok(name)
    }

    /// The keys of the tokens that tell of the node and its endpoints, in the order they came in.
    fn tokens(&self) -> Vec<String> {
        let endpoints = self.endpoints.iter();
        match self.convention {
            Convention::Silent => Vec::new(),
            Convention::Bridge => {
                endpoints.map(|endpoint| ros2dds::token(&self.node.session, endpoint)).collect()
            }
            Convention::RmwZenoh(graph) => {
                let numbered = (1..).zip(endpoints);
                let tokens = numbered.map(|(id, of)| graph.endpoint_token(&self.node, id, of));
                std::iter::once(graph.node_token(&self.node)).chain(tokens).collect()
            }
        }
    }

    /// Tells ROS 2 of the node and its endpoints, as long as the tokens live.
    pub(super) async fn announce(
        &self,
        session: &Session,
    ) -> Result<Vec<LivelinessToken>, ServingError> {
        let mut tokens = Vec::new();
        for token in self.tokens() {
            let key = key_expression(token)?;
            let token = session.liveliness().declare_token(key.clone()).await;
            tokens.push(token.map_err(|source| ServingError::Declare { key, source })?);
        }
        Ok(tokens)
    }
}

impl Signature {
    /// Any 16 bytes do that no other publisher has.
    fn of(token: &str) -> Self {
        let mut gid = [0; 16];
        gid.copy_from_slice(&Sha256::digest(token)[..16]);
        Self(Some(Arc::new(Signer { gid, sent: AtomicI64::new(0) })))
    }

    /// What to attach to the next message.
    pub(super) fn next(&self) -> Option<[u8; Attachment::LENGTH]> {
        let Signer { gid, sent } = self.0.as_deref()?;
        let sequence = sent.fetch_add(1, Ordering::Relaxed) + 1;
        let sent_ns = clock::unix_nanoseconds();
        Some(Attachment { sequence, sent_ns, gid: *gid }.to_bytes())
    }
}

impl Input {
    const fn qos(self) -> Qos {
        match self {
            // A bridge reads a topic as the first that it hears of wants it, and who wants
            // reliability would never hear a driver that does not offer it.
            Self::Scan => Qos::best_effort(5),
            Self::Odom | Self::Pose => Qos::best_effort(50),
            Self::Tf => Qos::best_effort(100),
            Self::TfStatic => Qos::latched(100),
        }
    }
}

/// Words of letters, digits and underlines, none beginning with a digit, with slashes between.
fn is_ros_name(name: &str) -> bool {
    name.split('/').all(|word| {
        word.starts_with(|first: char| first.is_ascii_alphabetic() || first == '_')
            && word.chars().all(|letter| letter.is_ascii_alphanumeric() || letter == '_')
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::graph::{GET_MAP, OCCUPANCY_GRID};

    const HUMBLE: Convention =
        Convention::RmwZenoh(Graph { domain: 3, hashes: TypeHashes::Unknown });

    fn node(prefix: &str, convention: Convention) -> RosNode {
        RosNode::new("a1".to_owned(), Prefix::parse(prefix).unwrap(), convention)
    }

    fn listened(node: &mut RosNode, names: &Keys) -> [String; 4] {
        let keys = node.inputs(names, Input::Odom).unwrap();
        keys.inputs().map(|input| keys.of(input).to_string())
    }

    #[test]
    fn inputs_can_be_renamed() {
        let names = Keys { scan: "front/scan".to_owned(), ..Keys::default() };
        let keys = listened(&mut node("robot01", Convention::Bridge), &names);
        let expected = ["robot01/front/scan", "robot01/odom", "robot01/tf", "robot01/tf_static"];
        assert_eq!(keys, expected);
        let [scan, .., tf_static] = listened(&mut node("robot01", HUMBLE), &names);
        assert_eq!(scan, "3/robot01/front/scan/sensor_msgs::msg::dds_::LaserScan_/*");
        assert_eq!(tf_static, "3/robot01/tf_static/tf2_msgs::msg::dds_::TFMessage_/*");
        let names = Keys { odom: "*".to_owned(), ..Keys::default() };
        let error = node("", Convention::Bridge).inputs(&names, Input::Odom).unwrap_err();
        assert_eq!(error, KeyError::Wildcard("*".to_owned()));
    }

    #[test]
    fn given_poses_are_listened_to_in_place_of_odometry() {
        let mut node = node("robot01", HUMBLE);
        let keys = node.inputs(&Keys::default(), Input::Pose).unwrap();
        assert_eq!(keys.inputs()[1], Input::Pose);
        assert_eq!(
            keys.of(Input::Pose).as_str(),
            "3/robot01/amcl_pose/geometry_msgs::msg::dds_::PoseWithCovarianceStamped_/*"
        );
        let tokens = node.tokens();
        assert!(tokens.iter().any(|token| token.contains("amcl_pose")), "{tokens:?}");
        assert!(!tokens.iter().any(|token| token.contains("odom")), "{tokens:?}");
    }

    #[test]
    fn a_name_that_ros_does_not_have_is_an_error_where_ros_nodes_read_it() {
        let names = Keys::default();
        assert!(node("robot-01", Convention::Bridge).inputs(&names, Input::Odom).is_ok());
        for prefix in ["robot-01", "1", "robot01/2nd"] {
            let error = node(prefix, HUMBLE).inputs(&names, Input::Odom).unwrap_err();
            assert_eq!(error, KeyError::NotRosName(format!("{prefix}/scan")));
        }
    }

    #[test]
    fn every_publisher_signs_as_another_and_counts_from_one() {
        let mut node = node("robot01", HUMBLE);
        let mut attachments = ["map", "other"].map(|name| {
            let output = node.output(name, OCCUPANCY_GRID, Qos::latched(1)).unwrap();
            [(); 2].map(|()| Attachment::from_bytes(&output.signature.next().unwrap()).unwrap())
        });
        for [first, second] in &mut attachments {
            assert_eq!((first.sequence, second.sequence), (1, 2));
            assert!(first.gid == second.gid && first.sent_ns <= second.sent_ns);
        }
        assert_ne!(attachments[0][0].gid, attachments[1][0].gid);
    }

    #[test]
    fn nothing_is_signed_or_announced_for_nobody() {
        let mut silent = node("robot01", Convention::Silent);
        let output = silent.output("map", OCCUPANCY_GRID, Qos::latched(1)).unwrap();
        assert_eq!(output.signature.next(), None);
        assert_eq!(output.key.as_str(), "robot01/map");
        assert_eq!(silent.service("dynamic_map", GET_MAP).unwrap(), None);
        assert!(silent.tokens().is_empty());
    }
}
