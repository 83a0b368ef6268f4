//! How ROS 2 nodes that run on `rmw_zenoh` find and understand each other: the keys of topics and
//! services, the attachment of every message, and the liveliness tokens of the graph.

use super::{Durability, Endpoint, Qos, Reliability, WireType};

/// Stands for the slash within a part of a token's key.
const SLASH: &str = "%";

/// What Humble says instead of a hash.
const NO_HASH: &str = "TypeHashNotSupported";

/// The enclave, which only DDS security uses, and the number of our one node in its session.
const ENCLAVE: &str = SLASH;
const NODE_ID: usize = 0;

/// Whether the graph's distribution knows hashes of types.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TypeHashes {
    /// Jazzy and later.
    Known,
    /// Humble.
    Unknown,
}

/// The graph that is joined.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Graph {
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// How its types are told.
    pub hashes: TypeHashes,
}

/// A node, as its tokens name it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Node {
    /// The id of its session, as Zenoh prints it.
    pub session: String,
    /// Its namespace without the leading slash; may be empty.
    pub namespace: String,
    /// Its name.
    pub name: &'static str,
}

impl Graph {
    /// The key that a publisher puts to and a service answers on.
    #[must_use]
    pub fn key(self, name: &str, wire_type: WireType) -> String {
        format!("{}/{name}/{}/{}", self.domain, dds_type(wire_type), self.hash(wire_type))
    }

    /// The key that a subscription listens to: publishers of every distribution.
    #[must_use]
    pub fn subscription_key(self, name: &str, wire_type: WireType) -> String {
        format!("{}/{name}/{}/*", self.domain, dds_type(wire_type))
    }

    /// The name of the topic or service that a key of the graph belongs to, and the graph's domain.
    #[must_use]
    pub fn name_in(key: &str) -> Option<(u32, &str)> {
        let (domain, rest) = key.split_once('/')?;
        let (rest, _hash) = rest.rsplit_once('/')?;
        let (name, dds_type) = rest.rsplit_once('/')?;
        let domain = domain.parse().ok()?;
        dds_type.contains("::dds_::").then_some((domain, name))
    }

    /// The key of the token that tells of a node.
    #[must_use]
    pub fn node_token(self, node: &Node) -> String {
        let Node { session, namespace, name } = node;
        let namespace = absolute(namespace);
        let Self { domain, .. } = self;
        format!("@ros2_lv/{domain}/{session}/{NODE_ID}/{NODE_ID}/NN/{ENCLAVE}/{namespace}/{name}")
    }

    /// The key of the token that tells of an endpoint of a node; `id` is its number in the
    /// session, from 1.
    #[must_use]
    pub fn endpoint_token(self, node: &Node, id: usize, endpoint: &Endpoint) -> String {
        let Node { session, namespace, name } = node;
        let (domain, role) = (self.domain, endpoint.role.code());
        format!(
            "@ros2_lv/{domain}/{session}/{NODE_ID}/{id}/{role}/{ENCLAVE}/{}/{name}/{}/{}/{}/{}",
            absolute(namespace),
            absolute(&endpoint.name),
            dds_type(endpoint.wire_type),
            self.hash(endpoint.wire_type),
            qos(endpoint.qos)
        )
    }

    const fn hash(self, wire_type: WireType) -> &'static str {
        match self.hashes {
            TypeHashes::Known => wire_type.hash,
            TypeHashes::Unknown => NO_HASH,
        }
    }
}

fn absolute(name: &str) -> String {
    format!("{SLASH}{}", name.replace('/', SLASH))
}

/// `sensor_msgs/msg/LaserScan` as DDS calls it.
fn dds_type(wire_type: WireType) -> String {
    match wire_type.name.rsplit_once('/') {
        Some((package, name)) => format!("{}::dds_::{name}_", package.replace('/', "::")),
        None => wire_type.name.to_owned(),
    }
}

/// Every policy that we care about is written out, for what is left out means something else in
/// other versions; deadline, lifespan and liveliness are left at "for ever".
fn qos(qos: Qos) -> String {
    let reliability = match qos.reliability {
        Reliability::Reliable => 1,
        Reliability::BestEffort => 2,
    };
    let durability = match qos.durability {
        Durability::TransientLocal => 1,
        Durability::Volatile => 2,
    };
    format!("{reliability}:{durability}:1,{}:,:,:,,", qos.depth)
}

/// What comes with every message and reply; messages without it are dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attachment {
    /// Counts the messages of the sender, from 1; a reply has that of the request.
    pub sequence: i64,
    /// When it was sent, nanoseconds since 1970.
    pub sent_ns: i64,
    /// Who sent it, or for a reply who asked.
    pub gid: [u8; 16],
}

impl Attachment {
    /// Bytes of an attachment.
    pub const LENGTH: usize = 33;

    /// As it travels: two numbers, little endian, and the length of the last part before it.
    #[must_use]
    pub fn to_bytes(self) -> [u8; Self::LENGTH] {
        let mut bytes = [0; Self::LENGTH];
        bytes[..8].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.sent_ns.to_le_bytes());
        bytes[16] = 16;
        bytes[17..].copy_from_slice(&self.gid);
        bytes
    }

    /// What the bytes say; `None` when they are no attachment.
    #[must_use]
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let bytes: &[u8; Self::LENGTH] = bytes.try_into().ok()?;
        let (sequence, rest) = bytes.split_first_chunk()?;
        let (sent, rest) = rest.split_first_chunk()?;
        let (length, gid) = rest.split_first()?;
        (*length == 16).then_some(Self {
            sequence: i64::from_le_bytes(*sequence),
            sent_ns: i64::from_le_bytes(*sent),
            gid: gid.try_into().ok()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::{GET_MAP, LASER_SCAN, OCCUPANCY_GRID, Role, TF_MESSAGE};
    use super::*;

    const JAZZY: Graph = Graph { domain: 0, hashes: TypeHashes::Known };
    const HUMBLE: Graph = Graph { domain: 7, hashes: TypeHashes::Unknown };

    #[test]
    fn keys_have_domain_name_type_and_hash() {
        assert_eq!(
            JAZZY.key("robot1/map", OCCUPANCY_GRID),
            "0/robot1/map/nav_msgs::msg::dds_::OccupancyGrid_/\
             RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7"
        );
        let service = "7/dynamic_map/nav_msgs::srv::dds_::GetMap_/TypeHashNotSupported";
        assert_eq!(HUMBLE.key("dynamic_map", GET_MAP), service);
        let scan = "0/robot1/scan/sensor_msgs::msg::dds_::LaserScan_/*";
        assert_eq!(JAZZY.subscription_key("robot1/scan", LASER_SCAN), scan);
        assert_eq!(Graph::name_in(scan), Some((0, "robot1/scan")));
        assert_eq!(Graph::name_in(service), Some((7, "dynamic_map")));
        assert_eq!(Graph::name_in("7/robot01/front/scan"), None);
    }

    #[test]
    fn tokens_are_those_of_the_design_document() {
        let node = |namespace: &str| Node {
            session: "aac3178e".to_owned(),
            namespace: namespace.to_owned(),
            name: "gmapd",
        };
        let endpoint = |role, name: &str, wire_type, qos| Endpoint {
            role,
            name: name.to_owned(),
            wire_type,
            qos,
        };
        let token = |id, endpoint| JAZZY.endpoint_token(&node("robot1"), id, &endpoint);
        let root = "@ros2_lv/0/aac3178e/0/0/NN/%/%/gmapd";
        assert_eq!(JAZZY.node_token(&node("")), root);
        let nested = "@ros2_lv/7/aac3178e/0/0/NN/%/%site%robot1/gmapd";
        assert_eq!(HUMBLE.node_token(&node("site/robot1")), nested);
        assert_eq!(
            token(2, endpoint(Role::Publisher, "robot1/map", OCCUPANCY_GRID, Qos::latched(1))),
            "@ros2_lv/0/aac3178e/0/2/MP/%/%robot1/gmapd/%robot1%map/\
             nav_msgs::msg::dds_::OccupancyGrid_/\
             RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7/1:1:1,1:,:,:,,"
        );
        let scan = endpoint(Role::Subscription, "robot1/scan", LASER_SCAN, Qos::best_effort(5));
        assert!(token(1, scan).ends_with("/2:2:1,5:,:,:,,"));
        let tf = token(3, endpoint(Role::Publisher, "robot1/tf", TF_MESSAGE, Qos::reliable(100)));
        assert!(tf.contains("/3/MP/") && tf.ends_with("/1:2:1,100:,:,:,,"), "{tf}");
        let service = endpoint(Role::Service, "robot1/dynamic_map", GET_MAP, Qos::SERVICE);
        let token = HUMBLE.endpoint_token(&node(""), 4, &service);
        assert_eq!(
            token,
            "@ros2_lv/7/aac3178e/0/4/SS/%/%/gmapd/%robot1%dynamic_map/\
             nav_msgs::srv::dds_::GetMap_/TypeHashNotSupported/1:2:1,10:,:,:,,"
        );
    }

    #[test]
    fn attachments_are_as_a_node_wrote_one() {
        let text = "0200000000000000332eb9537d44ea1810576e87488870263a7a55b54cff772afe";
        let bytes: Vec<u8> = (0..text.len())
            .step_by(2)
            .map(|at| u8::from_str_radix(&text[at..at + 2], 16).unwrap())
            .collect();
        let attachment = Attachment::from_bytes(&bytes).unwrap();
        assert_eq!(attachment.sequence, 2);
        assert_eq!(attachment.sent_ns, 0x18ea_447d_53b9_2e33);
        assert_eq!(attachment.gid[..3], [0x57, 0x6e, 0x87]);
        assert_eq!(attachment.to_bytes()[..], bytes[..]);
        assert_eq!(Attachment::from_bytes(&bytes[..32]), None);
        let mut other = bytes;
        other[16] = 15;
        assert_eq!(Attachment::from_bytes(&other), None);
    }
}
