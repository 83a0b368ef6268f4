//! `gmapd run`: live mapping on a Zenoh mesh.

mod answers;
pub mod command;
mod diagnostics;
pub mod formats;
pub mod keys;
pub mod ledger;
mod message_clock;
mod outputs;
mod queries;
pub mod save;
pub mod selector;
pub mod serving;
pub mod snapshot;
pub mod status;
