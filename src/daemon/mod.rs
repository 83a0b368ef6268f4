//! `gmapd run`: live mapping on a Zenoh mesh.

pub mod command;
pub mod keys;
pub mod ledger;
pub mod snapshot;
pub mod status;
