//! One case with its label and report, and the rules for a right verdict.

use std::sync::Arc;

use serde_json::Value;

/// A label, and the report that was made without it.
#[derive(Debug, Clone)]
pub struct Case {
    pub id: String,
    pub suite: String,
    pub label: Value,
    /// The output of `diagnose`: `report`, `check`, `next`, `error`.
    pub answer: Arc<Value>,
}

/// Kinds of verdicts that name an effect.
const NAMES_EFFECT: [&str; 2] = ["identified", "partial"];

/// Suites in which an abstention counts as true where the first hypothesis is wrong.
fn is_open(suite: &str) -> bool {
    ["no-repeats", "rough-rigs", "place", "force-over-displacement"].contains(&suite)
}

/// Suites in which an effect counts by its family.
fn counts_family(suite: &str) -> bool {
    suite == "other-equation" || is_open(suite)
}

/// Effects that are one law where the linear part is free too, as it is in situ: `y - clip(y)` and `clip(y)`
/// differ by a stiffness.
const ONE_LAW: [&str; 2] = ["bump_stop", "clearance"];

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

    /// Whether the verdict gives the true law by the other of two names that nothing measured tells apart.
    pub fn by_its_other_name(&self) -> bool {
        let stated = self.verdict()["effect"].as_str();
        self.suite == "in-situ"
            && ONE_LAW.contains(&self.truth())
            && stated.is_some_and(|e| e != self.truth() && ONE_LAW.contains(&e))
    }

    /// *Right*: the true effect first, by either name that it has, and the kind `identified` or `partial`; on
    /// several axes the axis too. Of nothing, noise and hum the kind that says so.
    pub fn is_right(&self) -> bool {
        let effect = &self.verdict()["effect"];
        match self.truth() {
            "nothing" => self.kind() == "no_material_gap",
            "raised_noise" | "periodic_disturbance" => {
                self.kind() == "noise_or_unmeasured_disturbance" && self.is_one_of(effect)
            }
            _ => {
                let named = self.is_one_of(effect) || self.by_its_other_name();
                self.names_effect() && named && self.axis_is_right()
            }
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

    /// Whether there is an effect at all.
    pub fn has_effect(&self) -> bool {
        self.truth() != "nothing"
    }

    /// Whether the first hypothesis is of the true effect's family.
    pub fn family_is_first(&self) -> bool {
        self.hypotheses().first().is_some_and(|h| self.family_is_one_of(&h["family"]))
    }

    /// Whether the verdict says where an effect acts, of those whose place is offered.
    pub fn states_place(&self) -> bool {
        let verdict = self.verdict();
        let states = self.states_family() || self.kind() == "not_distinguishable";
        states
            && self.effects().any(|e| e["place"].is_object())
            && !(verdict["at"].is_null() && verdict["between"].is_null())
    }

    /// Whether it is the place where the true effect acts: at a channel, or between two.
    pub fn place_is_right(&self) -> bool {
        let verdict = self.verdict();
        let pair = |value: &Value| -> Vec<String> {
            let names =
                value.as_array().into_iter().flatten().filter_map(|name| name.as_str().map(String::from));
            let mut names: Vec<String> = names.collect();
            names.sort();
            names
        };
        self.effects().map(|e| &e["place"]).any(|place| match place["at"].as_str() {
            Some(at) => verdict["at"] == at,
            None => {
                !pair(&place["between"]).is_empty() && pair(&place["between"]) == pair(&verdict["between"])
            }
        })
    }

    /// Probability of the verdict; 0 where there is none.
    pub fn stated_probability(&self) -> f64 {
        self.verdict()["probability"].as_f64().unwrap_or(0.0)
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

    /// How many true effects the verdict names, each with its axis.
    pub fn axes_found(&self) -> usize {
        let named = self.verdict()["effects"].as_array().map_or(&[][..], Vec::as_slice);
        let same = |a: &Value, b: &Value| a["effect"] == b["effect"] && a["axis"] == b["axis"];
        self.effects().filter(|e| self.names_effect() && named.iter().any(|n| same(e, n))).count()
    }

    /// Whether the verdict as it is stated is true: what its probability is of.
    pub fn verdict_is_true(&self) -> bool {
        let set_holds_family = || {
            let family = |e: &Value| self.hypotheses().iter().find(|h| h["effect"] == *e);
            self.set().iter().filter_map(family).any(|h| self.family_is_one_of(&h["family"]))
        };
        match (self.suite.as_str(), self.kind()) {
            ("struck", kind) => kind == "none_of_catalogue",
            // What is not measured and not predictable from the drive is rightly called a disturbance.
            ("outside", "noise_or_unmeasured_disturbance") => {
                ["unmeasured_force", "drop_outs"].contains(&self.truth())
            }
            ("outside", kind) => kind == "none_of_catalogue",
            ("nothing", _) => self.is_right(),
            // Where nothing but the model errs every verdict is true that blames nothing on the rig.
            ("sims-that-err", kind) if !self.has_effect() => {
                !self.is_blamed() && kind != "not_distinguishable"
            }
            (suite, "no_material_gap") if is_open(suite) => {
                self.label["gap"].as_f64().is_some_and(|gap| gap < 0.04)
            }
            // To abstain is right where the first hypothesis is not.
            (suite, "undecided" | "none_of_catalogue") if is_open(suite) => !self.family_is_first(),
            (suite, "not_distinguishable") if counts_family(suite) => set_holds_family(),
            (suite, _) if counts_family(suite) => self.family_is_right(),
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

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn case(suite: &str, effect: &str, family: &str, axes: u64, verdict: Value) -> Case {
        let label = json!({"effects": [{"effect": effect, "family": family, "axis": "y"}], "axes": axes});
        Case {
            id: "0".into(),
            suite: suite.into(),
            label,
            answer: Arc::new(json!({"report": {"verdict": verdict}})),
        }
    }

    fn verdict(kind: &str, effect: Option<&str>, family: Option<&str>) -> Value {
        json!({"kind": kind, "effect": effect, "family": family, "axis": "x", "equivalence_set": []})
    }

    #[test]
    fn right_is_the_true_effect_stated_and_the_right_family_is_no_blame() {
        let of = |v: Value| case("catalogue", "gain", "linear", 1, v);
        let partial = of(verdict("partial", Some("gain"), Some("linear")));
        assert!(partial.is_right() && partial.is_blamed() && partial.verdict_is_true());
        let other = of(verdict("identified", Some("delay"), Some("linear")));
        assert!(!other.is_right() && other.family_is_right() && other.is_blamed());
        let family = of(verdict("family_only", None, Some("linear")));
        assert!(!family.is_right() && family.family_is_right() && !family.is_blamed());
        assert!(family.verdict_is_true());
        let wrong = of(verdict("family_only", None, Some("damping")));
        assert!(wrong.is_blamed() && !wrong.verdict_is_true());
        let silent = of(verdict("none_of_catalogue", None, None));
        assert!(!silent.is_blamed() && !silent.family_is_right() && !silent.verdict_is_true());
    }

    #[test]
    fn a_place_is_a_channel_or_two_in_any_order() {
        let of = |place: Value, verdict: Value| {
            let mut case = case("place", "clearance", "stiffness", 1, verdict);
            case.label["effects"][0]["place"] = place;
            (case.states_place(), case.place_is_right())
        };
        let stated = |at: Value, between: Value| {
            let mut verdict = verdict("partial", Some("clearance"), Some("stiffness"));
            (verdict["at"], verdict["between"]) = (at, between);
            verdict
        };
        let (one, two) = (json!({"at": "disp_1"}), json!({"between": ["disp_1", "disp_2"]}));
        assert_eq!(of(one.clone(), stated(json!("disp_1"), Value::Null)), (true, true));
        assert_eq!(of(one.clone(), stated(json!("disp_2"), Value::Null)), (true, false));
        assert_eq!(of(two.clone(), stated(Value::Null, json!(["disp_2", "disp_1"]))), (true, true));
        assert_eq!(of(two, stated(json!("disp_1"), Value::Null)), (true, false));
        assert_eq!(of(Value::Null, stated(json!("disp_1"), Value::Null)), (false, false));
        assert_eq!(of(one, stated(Value::Null, Value::Null)), (false, false));
    }

    #[test]
    fn on_several_axes_the_axis_counts() {
        let v = verdict("identified", Some("gain"), Some("linear"));
        assert!(!case("three-axes", "gain", "linear", 3, v.clone()).is_right());
        assert!(case("catalogue", "gain", "linear", 1, v).is_right());
    }

    #[test]
    fn one_law_has_two_names_in_situ_and_only_there() {
        let v = || verdict("identified", Some("bump_stop"), Some("stiffness"));
        let of = |suite, effect| case(suite, effect, "stiffness", 1, v());
        let other = of("in-situ", "clearance");
        assert!(other.is_right() && other.by_its_other_name() && other.verdict_is_true());
        let own = of("in-situ", "bump_stop");
        assert!(own.is_right() && !own.by_its_other_name());
        assert!(!of("in-situ", "cubic_stiffness").is_right());
        assert!(!of("catalogue", "clearance").is_right());
    }

    #[test]
    fn where_the_truth_is_struck_only_abstention_is_true() {
        let v = verdict("not_distinguishable", None, None);
        let open = case("struck", "gain", "linear", 1, v);
        assert!(!open.is_blamed() && !open.verdict_is_true());
        let none = case("struck", "gain", "linear", 1, verdict("none_of_catalogue", None, None));
        assert!(!none.is_blamed() && none.verdict_is_true());
    }

    #[test]
    fn noise_is_not_blamed_on_a_drive() {
        let hum =
            verdict("noise_or_unmeasured_disturbance", Some("periodic_disturbance"), Some("disturbance"));
        let right = case("nothing", "periodic_disturbance", "disturbance", 1, hum.clone());
        assert!(right.is_right() && !right.is_blamed_on_drive());
        assert!(!case("nothing", "raised_noise", "disturbance", 1, hum).is_right());
        let gain = verdict("partial", Some("gain"), Some("linear"));
        assert!(case("nothing", "nothing", "", 1, gain).is_blamed_on_drive());
    }

    #[test]
    fn a_diagnosis_that_failed_is_wrong_and_blames_nobody() {
        let failed = case("catalogue", "gain", "linear", 1, Value::Null);
        assert!(!failed.is_right() && !failed.is_blamed() && !failed.verdict_is_true());
        assert_eq!(failed.stated(), "failed");
    }
}
