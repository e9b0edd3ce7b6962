//! The bars of the promises, judged where they are measured.

use serde_json::json;

/// What was held against its bar so far.
#[derive(Default)]
#[must_use]
pub struct Bars {
    missed: usize,
}

impl Bars {
    /// A figure that may be no larger than its bar.
    pub fn at_most(&mut self, name: &str, found: f64, bar: f64) {
        self.judge(name, found, bar, "at most", found <= bar);
    }

    /// A figure that may be no smaller than its bar.
    pub fn at_least(&mut self, name: &str, found: f64, bar: f64) {
        self.judge(name, found, bar, "at least", found >= bar);
    }

    fn judge(&mut self, name: &str, found: f64, bar: f64, sense: &str, met: bool) {
        println!("{}", json!({"bar": name, "found": found, sense: bar, "met": met}));
        self.missed += usize::from(!met);
    }

    /// Ends the program with an error where a bar was missed; after every service has been stopped.
    pub fn end(self) {
        if self.missed > 0 {
            eprintln!("{} bars missed", self.missed);
            std::process::exit(1);
        }
    }
}
