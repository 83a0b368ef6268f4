//! How the graph of ROS 2 learns of endpoints on a Zenoh mesh: roles, types and qualities of
//! service, and the texts that tell them.

pub mod rmw_zenoh;
pub mod ros2dds;
mod types;

pub use types::{
    DIAGNOSTIC_ARRAY, FLOAT64, GET_MAP, LASER_SCAN, MAP_META_DATA, OCCUPANCY_GRID,
    OCCUPANCY_GRID_UPDATE, ODOMETRY, PATH, POSE_ARRAY, POSE_WITH_COVARIANCE_STAMPED, TF_MESSAGE,
    WireType,
};

/// What an endpoint does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Sends messages.
    Publisher,
    /// Receives messages.
    Subscription,
    /// Answers requests.
    Service,
}

impl Role {
    /// As both conventions abbreviate it.
    const fn code(self) -> &'static str {
        match self {
            Self::Publisher => "MP",
            Self::Subscription => "MS",
            Self::Service => "SS",
        }
    }
}

/// Whether what is lost is sent again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reliability {
    /// It is not. A subscription that asks for no more than this matches every publisher.
    BestEffort,
    /// It is.
    Reliable,
}

/// Whether who comes late is told what was last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Durability {
    /// No.
    Volatile,
    /// Yes, by the publisher.
    TransientLocal,
}

/// Quality of service, of those policies that gmapd does not leave at their defaults.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Qos {
    /// Whether what is lost is sent again.
    pub reliability: Reliability,
    /// Whether who comes late is told what was last.
    pub durability: Durability,
    /// Messages that are kept.
    pub depth: usize,
}

impl Qos {
    /// What a service has.
    pub const SERVICE: Self = Self::reliable(10);

    /// Nothing is sent again.
    #[must_use]
    pub const fn best_effort(depth: usize) -> Self {
        Self { reliability: Reliability::BestEffort, durability: Durability::Volatile, depth }
    }

    /// What is lost is sent again.
    #[must_use]
    pub const fn reliable(depth: usize) -> Self {
        Self { reliability: Reliability::Reliable, durability: Durability::Volatile, depth }
    }

    /// As [`Self::reliable`], and who comes late is told the last messages.
    #[must_use]
    pub const fn latched(depth: usize) -> Self {
        Self { reliability: Reliability::Reliable, durability: Durability::TransientLocal, depth }
    }
}

/// A publisher, a subscription or a service.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Endpoint {
    /// What it does.
    pub role: Role,
    /// Its ROS name without the leading slash, which is its key where no convention changes it.
    pub name: String,
    /// What it carries.
    pub wire_type: WireType,
    /// How it carries it.
    pub qos: Qos,
}
