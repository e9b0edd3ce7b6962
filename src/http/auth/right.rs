//! The right that an operation requires of its caller.

use super::Caller;
use crate::domain::TokenRole;
use crate::http::codes;
use crate::http::problem::{Answer, Problem};

/// The right to an operation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Right {
    /// Everybody has it.
    Public,
    /// A token of this role or a higher one has it, for the token's rigs.
    Role(TokenRole),
    /// A token of this role or a higher one has it, if it is not limited to some rigs.
    AllRigs(TokenRole),
}

impl Right {
    /// Checks that the caller has it.
    ///
    /// # Errors
    /// `token.role`, `token.scope`.
    pub(super) fn check(self, caller: &Caller) -> Answer<()> {
        let (Self::Role(role) | Self::AllRigs(role)) = self else { return Ok(()) };
        if caller.role() < role {
            let (needed, found) = (role.as_str(), caller.role().as_str());
            let detail = format!("This operation needs the role {needed}; the token has {found}.");
            return Err(Problem::new(codes::TOKEN_ROLE, detail));
        }
        if matches!(self, Self::AllRigs(_)) && caller.scope().is_some() {
            let detail = "This operation needs a token for all rigs; this one is limited to some.";
            return Err(Problem::new(codes::TOKEN_SCOPE, detail));
        }
        Ok(())
    }
}
