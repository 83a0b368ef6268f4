//! 2D laser mapping for robots on a Zenoh mesh.
//!
//! The modules in the order in which to read them:
//!
//! - [`slam`]: the pure core, poses to particle filter;
//! - [`sim`]: made-up worlds, lasers and odometry with exact truth;
//! - [`logs`]: recorded input;
//! - [`config`]: the one configuration file;
//! - [`ros`]: ROS 2 messages and their bytes;
//! - [`convert`]: from messages to the core and back;
//! - [`timeline`], [`tf`]: odometry and frames between two messages;
//! - [`replay`]: a log through the filter, and what came of it;
//! - [`playback`]: a log as live messages;
//! - [`doctor`]: what is wrong with a robot's scans and odometry;
//! - [`map`]: maps as pictures and map_server files;
//! - [`evaluation`]: how far a trajectory is from the truth;
//! - [`checkpoint`]: the state in files, and what is good of them;
//! - [`given_poses`]: poses of a file, to map along;
//! - [`daemon`]: live mapping on a Zenoh mesh;
//! - [`client`]: for programs on the mesh that follow robots;
//! - [`recorded`]: recorded messages in the order in which the daemon takes them;
//! - [`files`], [`clock`], [`statistics`]: whole files, clocks, percentiles.

pub mod checkpoint;
pub mod client;
pub mod clock;
pub mod config;
pub mod convert;
pub mod daemon;
pub mod doctor;
pub mod evaluation;
pub mod files;
pub mod given_poses;
pub mod logs;
pub mod map;
pub mod playback;
pub mod recorded;
pub mod replay;
pub mod ros;
pub mod sim;
pub mod slam;
pub mod statistics;
pub mod tf;
pub mod timeline;
