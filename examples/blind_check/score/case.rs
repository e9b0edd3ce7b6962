//! One case with its label and report, and what counts as right.

use std::sync::Arc;

use serde_json::Value;

/// A label, and the report that was made without it.
#[derive(Debug, Clone)]
pub struct Case {
    pub id: String,
    pub suite: String,
    pub label: Value,
    /// What `diagnose` wrote: `report`, `check`, `next`, `error`.
    pub answer: Arc<Value>,
}

/// Kinds of verdicts that name an effect.
const NAMES_EFFECT: [&str; 2] = ["identified", "partial"];

impl Case {
    /// The report; `Null` where the diagnosis failed.
    pub fn report(&self) -> &Value {
        &self.answer["report"]
    }

    pub fn verdict(&self) -> &Value {
        &self.report()["verdict"]
    }

    /// Kind of the verdict, `failed` where there is none.
    pub fn kind(&self) -> &str {
        self.verdict()["kind"].as_str().unwrap_or("failed")
    }

    /// True effects: one, or two at once.
    pub fn effects(&self) -> impl Iterator<Item = &Value> {
        self.label["effects"].as_array().into_iter().flatten()
    }

    /// The (first) true effect's name.
    pub fn truth(&self) -> &str {
        self.label["effects"][0]["effect"].as_str().unwrap_or("")
    }

    fn is_one_of(&self, effect: &Value) -> bool {
        self.effects().any(|e| e["effect"] == *effect)
    }

    fn family_is_one_of(&self, family: &Value) -> bool {
        !family.is_null() && self.effects().any(|e| e["family"] == *family)
    }

    /// Hypotheses, best first.
    pub fn hypotheses(&self) -> &[Value] {
        self.report()["hypotheses"].as_array().map_or(&[], Vec::as_slice)
    }

    /// The hypothesis that the verdict blames.
    pub fn blamed_hypothesis(&self) -> Option<&Value> {
        self.hypotheses().iter().find(|h| h["effect"] == self.verdict()["effect"])
    }

    fn names_effect(&self) -> bool {
        NAMES_EFFECT.contains(&self.kind())
    }

    /// Whether the axis is the one, of rigs with several.
    fn axis_is_right(&self) -> bool {
        self.label["axes"].as_u64() < Some(2) || self.effects().any(|e| e["axis"] == self.verdict()["axis"])
    }

    /// *Right*: the true effect first and the kind `identified` or `partial`; on several axes the axis
    /// too. Of nothing, noise and hum the kind that says so.
    pub fn is_right(&self) -> bool {
        let effect = &self.verdict()["effect"];
        match self.truth() {
            "nothing" => self.kind() == "no_material_gap",
            "raised_noise" | "periodic_disturbance" => {
                self.kind() == "noise_or_unmeasured_disturbance" && self.is_one_of(effect)
            }
            _ => self.names_effect() && self.is_one_of(effect) && self.axis_is_right(),
        }
    }

    /// *Right family*: it is stated, with or without an effect of it.
    pub fn family_is_right(&self) -> bool {
        self.states_family() && self.family_is_one_of(&self.verdict()["family"])
    }

    fn states_family(&self) -> bool {
        self.names_effect() || self.kind() == "family_only"
    }

    /// *Blamed*: `identified` or `partial`, or `family_only` with a wrong family.
    pub fn is_blamed(&self) -> bool {
        self.names_effect() || (self.kind() == "family_only" && !self.family_is_right())
    }

    /// Blamed on something that a drive causes.
    pub fn is_blamed_on_drive(&self) -> bool {
        let verdict = self.verdict();
        self.is_blamed() && verdict["family"] != "disturbance" && verdict["effect"] != "quantisation"
    }

    /// Effects that the report cannot tell apart.
    pub fn set(&self) -> &[Value] {
        self.verdict()["equivalence_set"].as_array().map_or(&[], Vec::as_slice)
    }

    pub fn truth_is_in_set(&self) -> bool {
        self.set().iter().any(|e| self.is_one_of(e))
    }

    /// Both true effects are the first hypothesis and the second effect.
    pub fn both_are_found(&self) -> bool {
        let first = &self.hypotheses().first().unwrap_or(&Value::Null)["effect"];
        let second = &self.report()["remaining"]["second_effect"]["effect"];
        self.is_one_of(first) && self.is_one_of(second) && first != second
    }

    /// Whether the verdict as it is stated is true: what its probability is of.
    pub fn verdict_is_true(&self) -> bool {
        let set_holds_family = || {
            let family = |e: &Value| self.hypotheses().iter().find(|h| h["effect"] == *e);
            self.set().iter().filter_map(family).any(|h| self.family_is_one_of(&h["family"]))
        };
        match (self.suite.as_str(), self.kind()) {
            ("struck", kind) => kind == "none_of_catalogue",
            // What is not measured and not predictable is rightly called a disturbance.
            ("outside", "noise_or_unmeasured_disturbance") => self.truth() == "unmeasured_force",
            ("outside", kind) => kind == "none_of_catalogue",
            ("nothing", _) => self.is_right(),
            ("other-equation", "not_distinguishable") => set_holds_family(),
            ("other-equation", _) => self.family_is_right(),
            (_, "family_only") => self.family_is_right(),
            (_, "not_distinguishable") => self.truth_is_in_set(),
            _ => self.is_right(),
        }
    }

    /// How the verdict reads in the confusion matrix.
    pub fn stated(&self) -> String {
        let verdict = self.verdict();
        let word = |key: &str| verdict[key].as_str().unwrap_or("?").to_owned();
        match self.kind() {
            "identified" | "partial" => word("effect"),
            "noise_or_unmeasured_disturbance" => {
                verdict["effect"].as_str().map_or("noise_or_unmeasured_disturbance".into(), String::from)
            }
            "family_only" => format!("family {}", word("family")),
            kind => kind.to_owned(),
        }
    }
}
