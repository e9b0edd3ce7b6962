//! The instruction set of the kernels: the best of the machine unless `RIGCAST_ISA` names another.

use std::sync::OnceLock;

use crate::EngineError;

/// Environment variable that names an instruction set: `portable`, `avx2` or `avx512`.
pub const ISA_VARIABLE: &str = "RIGCAST_ISA";

/// Instruction set of the kernels. The LSTM's results agree within rounding; on one set they are bit-equal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Isa {
    /// The set that every machine of the target has; no fused multiply-add.
    Portable,
    /// AVX2, FMA, BMI1 and BMI2.
    Avx2,
    /// AVX-512 F, VL, DQ and BW, which all but the first such machines have.
    Avx512,
}

impl Isa {
    /// All, from the slowest to the fastest.
    pub const ALL: [Self; 3] = [Self::Portable, Self::Avx2, Self::Avx512];

    /// Name as in [`ISA_VARIABLE`].
    pub fn name(self) -> &'static str {
        match self {
            Self::Portable => "portable",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
        }
    }

    /// Whether this machine can run it.
    pub fn is_available(self) -> bool {
        match self {
            Self::Portable => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => super::x86::has_avx2(),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => super::x86::has_avx512(),
            #[cfg(not(target_arch = "x86_64"))]
            Self::Avx2 | Self::Avx512 => false,
        }
    }

    /// The set that `wish` names or, without one, the fastest set of the machine.
    ///
    /// # Errors
    /// An unknown name, or a set that this machine lacks.
    pub fn choose(wish: Option<&str>) -> Result<Self, EngineError> {
        let Some(wish) = wish.filter(|w| !w.is_empty()) else {
            return Ok(Self::ALL.into_iter().rev().find(|i| i.is_available()).unwrap_or(Self::Portable));
        };
        let refuse = |limit: &str| EngineError::Setting {
            setting: ISA_VARIABLE,
            found: wish.to_owned(),
            limit: limit.to_owned(),
        };
        let isa = Self::ALL
            .into_iter()
            .find(|i| i.name() == wish)
            .ok_or_else(|| refuse("one of portable, avx2, avx512"))?;
        if isa.is_available() { Ok(isa) } else { Err(refuse("an instruction set that this machine has")) }
    }

    /// The set of this process; the environment is read once.
    ///
    /// # Errors
    /// [`ISA_VARIABLE`] names something unknown, or a set that this machine lacks.
    pub fn of_process() -> Result<Self, EngineError> {
        static CHOSEN: OnceLock<Result<Isa, EngineError>> = OnceLock::new();
        CHOSEN.get_or_init(|| Self::choose(std::env::var(ISA_VARIABLE).ok().as_deref())).clone()
    }

    /// The set of this process for loops whose results are the same on every set: portable where it cannot be told,
    /// since such a process fits and predicts nothing, and says why.
    pub(crate) fn of_plain_loops() -> Self {
        Self::of_process().unwrap_or(Self::Portable)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_portable_set_can_always_be_chosen_and_unknown_names_are_refused() {
        assert_eq!(Isa::choose(Some("portable")), Ok(Isa::Portable));
        assert!(Isa::choose(None).unwrap().is_available());
        assert_eq!(Isa::choose(None), Isa::choose(Some("")));
        assert!(matches!(
            Isa::choose(Some("sse9")),
            Err(EngineError::Setting { setting: ISA_VARIABLE, found, .. }) if found == "sse9"
        ));
    }
}
