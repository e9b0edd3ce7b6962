//! The bench's channels, in the words of the HTTP contract.

use serde::Serialize;

/// One channel of the bench; serialises to the contract's channel object.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct RigChannel {
    /// Name, unique within the rig.
    pub name: &'static str,
    /// Unit of its samples.
    pub unit: &'static str,
    /// `drive` or `response`.
    pub role: &'static str,
    /// `force` or `displacement`.
    pub quantity: &'static str,
    /// `x`, `y` or `z`.
    pub axis: &'static str,
    /// Three channels of one group, in order, are x, y, z for Multi-Rain; drives have none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub group: Option<&'static str>,
}

const fn drive(name: &'static str, axis: &'static str) -> RigChannel {
    RigChannel { name, unit: "kN", role: "drive", quantity: "force", axis, group: None }
}

const fn displacement(name: &'static str, axis: &'static str) -> RigChannel {
    RigChannel {
        name,
        unit: "mm",
        role: "response",
        quantity: "displacement",
        axis,
        group: Some("displacement"),
    }
}

const fn force(name: &'static str, axis: &'static str) -> RigChannel {
    RigChannel { name, unit: "kN", role: "response", quantity: "force", axis, group: Some("force") }
}

/// Three drives, then six responses in the order of a simulated signal's channels.
pub static CHANNELS: [RigChannel; 9] = [
    drive("drive_x", "x"),
    drive("drive_y", "y"),
    drive("drive_z", "z"),
    displacement("disp_x", "x"),
    displacement("disp_y", "y"),
    displacement("disp_z", "z"),
    force("force_x", "x"),
    force("force_y", "y"),
    force("force_z", "z"),
];
