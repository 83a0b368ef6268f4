//! The `gmapd` command.
fn main() {}
