//! What `zenoh-bridge-ros2dds` wants to be told, as other bridges tell it: a liveliness token for
//! each endpoint.
//!
//! For each it makes an endpoint on DDS, so that `ros2 topic list` shows it.

use super::{Durability, Endpoint, Qos, Reliability, Role};

/// Stands for the slash within a part of a token's key.
const SLASH: &str = "§";

/// The key of the token that tells bridges of an endpoint of the session with this id.
#[must_use]
pub fn token(session: &str, endpoint: &Endpoint) -> String {
    let name = endpoint.name.replace('/', SLASH);
    let wire_type = endpoint.wire_type.name.replace('/', SLASH);
    let token = format!("@/{session}/@ros2_lv/{}/{name}/{wire_type}", endpoint.role.code());
    match endpoint.role {
        Role::Publisher | Role::Subscription => {
            format!("{token}/{}:typehash={};", qos(endpoint.qos), endpoint.wire_type.hash)
        }
        Role::Service => token,
    }
}

/// A topic without a DDS key, which none of ours has, begins with nothing; the last but one is
/// "keep the last".
fn qos(qos: Qos) -> String {
    let reliability = match qos.reliability {
        Reliability::BestEffort => 0,
        Reliability::Reliable => 1,
    };
    let durability = match qos.durability {
        Durability::Volatile => 0,
        Durability::TransientLocal => 1,
    };
    format!(":{reliability}:{durability}:0,{}", qos.depth)
}

#[cfg(test)]
mod tests {
    use super::super::{GET_MAP, LASER_SCAN, OCCUPANCY_GRID};
    use super::*;

    #[test]
    fn tokens_are_those_that_bridges_make() {
        let map = Endpoint {
            role: Role::Publisher,
            name: "robot1/map".to_owned(),
            wire_type: OCCUPANCY_GRID,
            qos: Qos::latched(1),
        };
        assert_eq!(
            token("b51d6e", &map),
            "@/b51d6e/@ros2_lv/MP/robot1§map/nav_msgs§msg§OccupancyGrid/:1:1:0,1:\
             typehash=RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7;"
        );
        let scan = Endpoint {
            role: Role::Subscription,
            name: "scan".to_owned(),
            wire_type: LASER_SCAN,
            qos: Qos::best_effort(5),
        };
        let expected = "@/a1/@ros2_lv/MS/scan/sensor_msgs§msg§LaserScan/:0:0:0,5:typehash=RIHS01_";
        assert!(token("a1", &scan).starts_with(expected));
        let service = Endpoint {
            role: Role::Service,
            name: "site/robot1/dynamic_map".to_owned(),
            wire_type: GET_MAP,
            qos: Qos::SERVICE,
        };
        let expected = "@/a1/@ros2_lv/SS/site§robot1§dynamic_map/nav_msgs§srv§GetMap";
        assert_eq!(token("a1", &service), expected);
    }
}
