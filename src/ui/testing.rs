//! What tests of several pages need.

use super::frame::Visitor;
use crate::domain::{Rig, RigDraft, TokenRole};

/// A person with a role.
pub fn visitor(role: TokenRole) -> Visitor {
    Visitor { token: Some("<b>desk</b>".into()), role, all_rigs: true, csrf: "secret".into() }
}

/// A rig whose names try to be more than text.
pub fn hostile_rig() -> Rig {
    let draft: RigDraft = serde_json::from_value(serde_json::json!({
        "id": "bench", "name": "<script>alert(1)</script>\" onmouseover=\"x \u{202e}", "sample_rate_hz": 1000.0,
        "channels": [
            {"name": "<img src=x>", "unit": "<i>", "role": "drive"},
            {"name": "force_x", "unit": "kN", "role": "response"},
        ],
    }))
    .unwrap();
    Rig {
        id: draft.id,
        name: draft.name,
        sample_rate_hz: draft.sample_rate_hz,
        channels: draft.channels,
        fit_policy: draft.fit_policy,
        created_at: "2026-03-01T12:00:00Z".parse().unwrap(),
        updated_at: "2026-03-01T12:00:00Z".parse().unwrap(),
        revision: 1,
    }
}
