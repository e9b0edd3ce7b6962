//! Tokens: a role, the rigs it is limited to, and the secret that proves it.

use std::collections::BTreeSet;
use std::fmt;

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use jiff::Timestamp;
use rand::TryRng;
use rand::rngs::SysRng;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;

use super::ids::RigId;
use super::problem::FieldError;
use super::text::check_text;

/// Id of a token (UUID v7); not secret.
pub type TokenId = uuid::Uuid;

/// Most rigs that a token may be limited to.
const MAX_RIGS: usize = 1000;

/// The role of a token; each role includes those before it.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
pub enum TokenRole {
    /// Reads and predicts.
    Reader,
    /// Uploads, fits, diagnoses, activates.
    Operator,
    /// Deletes, imports, makes tokens.
    Admin,
}

impl TokenRole {
    /// The word of the contract.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Reader => "reader",
            Self::Operator => "operator",
            Self::Admin => "admin",
        }
    }
}

/// The secret of a token: 256 random bits. Only [`Secret::reveal`] prints it.
#[derive(Clone)]
pub struct Secret(String);

/// SHA-256 of a secret; the secret itself is not stored. With 256 random bits in the secret a slow hash
/// would add nothing.
#[derive(Clone, Copy)]
pub struct SecretDigest([u8; 32]);

/// A token to be made.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TokenDraft {
    /// Name for people; may be empty.
    #[serde(default)]
    pub name: String,
    /// Its role.
    pub role: TokenRole,
    /// Rigs that it is limited to, which need not exist yet; `None`: all.
    #[serde(default)]
    pub rigs: Option<BTreeSet<RigId>>,
    /// When it expires; `None`: never.
    #[serde(default)]
    pub expires_at: Option<Timestamp>,
}

/// A token, without its secret.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Token {
    /// Id.
    pub id: TokenId,
    /// Name for people; may be empty.
    pub name: String,
    /// Its role.
    pub role: TokenRole,
    /// Rigs that it is limited to; `None`: all.
    pub rigs: Option<BTreeSet<RigId>>,
    /// When it was made.
    pub created_at: Timestamp,
    /// When it expires; `None`: never.
    pub expires_at: Option<Timestamp>,
}

impl Secret {
    /// Draws a new one from the system's randomness, the only draw without a seed.
    ///
    /// # Errors
    /// A system that gives no randomness.
    pub fn draw() -> Result<Self, rand::rngs::SysError> {
        let mut bits = [0; 32];
        SysRng.try_fill_bytes(&mut bits)?;
        // The prefix lets people and scanners of repositories recognise a leaked secret.
        Ok(Self(format!("rigcast_{}", URL_SAFE_NO_PAD.encode(bits))))
    }

    /// The secret as text, to be shown once.
    pub fn reveal(&self) -> &str {
        &self.0
    }

    /// Its digest.
    pub fn digest(&self) -> SecretDigest {
        SecretDigest::of(self.0.as_bytes())
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret(..)")
    }
}

impl SecretDigest {
    /// Digest of a text that a client presents as a secret.
    pub fn of(presented: &[u8]) -> Self {
        Self(Sha256::digest(presented).into())
    }

    /// A digest that was stored.
    pub fn stored(bytes: [u8; 32]) -> Self {
        Self(bytes)
    }

    /// As it is stored.
    pub fn as_bytes(&self) -> &[u8; 32] {
        &self.0
    }

    /// The first half, which a table is indexed by; [`SecretDigest::matches`] compares the whole.
    pub fn half(&self) -> [u8; 16] {
        *self.0.first_chunk().expect("a digest has 32 bytes")
    }

    /// Whether both are equal, in a time that does not depend on how much of them is.
    pub fn matches(&self, other: &Self) -> bool {
        self.0.ct_eq(&other.0).into()
    }
}

impl fmt::Debug for SecretDigest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SecretDigest(..)")
    }
}

impl TokenDraft {
    /// Checks it at `now`.
    ///
    /// # Errors
    /// The fields outside their limits, each with its limit.
    pub fn check(&self, now: Timestamp) -> Result<(), Vec<FieldError>> {
        let mut errors = Vec::new();
        check_text(&mut errors, "/name", &self.name, 0);
        if self.rigs.as_ref().is_some_and(|rigs| rigs.is_empty() || rigs.len() > MAX_RIGS) {
            errors.push(FieldError::new("/rigs", format!("1 to {MAX_RIGS} rigs, or null for all")));
        }
        if self.expires_at.is_some_and(|at| at <= now) {
            errors.push(FieldError::new("/expires_at", format!("after now, {now:.0}")));
        }
        if errors.is_empty() { Ok(()) } else { Err(errors) }
    }

    /// Whether it may be the first one, whose holder must be able to make all others.
    pub fn may_be_first(&self) -> bool {
        self.role == TokenRole::Admin && self.rigs.is_none()
    }
}

impl Token {
    /// Whether it is in force at `now`.
    pub fn is_in_force(&self, now: Timestamp) -> bool {
        self.expires_at.is_none_or(|at| now < at)
    }

    /// Whether its scope includes a rig, which need not exist.
    pub fn reaches(&self, rig: &RigId) -> bool {
        self.rigs.as_ref().is_none_or(|rigs| rigs.contains(rig))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn draft() -> TokenDraft {
        serde_json::from_str(r#"{"role": "operator"}"#).unwrap()
    }

    fn now() -> Timestamp {
        "2026-03-01T12:00:00Z".parse().unwrap()
    }

    #[test]
    fn secrets_have_256_bits_differ_and_show_themselves_nowhere_else() {
        let (one, other) = (Secret::draw().unwrap(), Secret::draw().unwrap());
        let text = one.reveal().strip_prefix("rigcast_").unwrap();
        assert_eq!(URL_SAFE_NO_PAD.decode(text).unwrap().len(), 32);
        assert_ne!(one.reveal(), other.reveal());
        assert!(!format!("{one:?} {:?}", one.digest()).contains(&text[..6]));
        assert!(one.digest().matches(&SecretDigest::of(one.reveal().as_bytes())));
        assert!(!one.digest().matches(&other.digest()));
    }

    #[test]
    fn bits_of_secrets_are_spread_evenly() {
        let mut ones = [0_u32; 256];
        for _ in 0..2000 {
            let secret = Secret::draw().unwrap();
            let bits = URL_SAFE_NO_PAD.decode(&secret.reveal()["rigcast_".len()..]).unwrap();
            for (i, count) in ones.iter_mut().enumerate() {
                *count += u32::from(bits[i / 8] >> (i % 8) & 1);
            }
        }
        // 1000 +- six standard deviations of 22.4.
        assert!(ones.iter().all(|n| (866..=1134).contains(n)), "{ones:?}");
    }

    #[test]
    fn roles_rise() {
        assert!(TokenRole::Reader < TokenRole::Operator && TokenRole::Operator < TokenRole::Admin);
    }

    #[test]
    fn a_draft_is_checked_and_only_an_admin_of_all_rigs_comes_first() {
        assert_eq!(draft().check(now()), Ok(()));
        let wrong = TokenDraft {
            name: "x".repeat(1001),
            rigs: Some(BTreeSet::new()),
            expires_at: Some(now()),
            ..draft()
        };
        let pointers: Vec<String> =
            wrong.check(now()).unwrap_err().into_iter().map(|error| error.pointer).collect();
        assert_eq!(pointers, ["/name", "/rigs", "/expires_at"]);
        assert!(!draft().may_be_first());
        let admin = TokenDraft { role: TokenRole::Admin, ..draft() };
        assert!(admin.may_be_first());
        let scoped = TokenDraft { rigs: Some(["a".parse().unwrap()].into()), ..admin };
        assert!(!scoped.may_be_first());
    }

    #[test]
    fn a_token_ends_at_its_expiry_and_reaches_its_rigs() {
        let TokenDraft { name, role, .. } = draft();
        let rigs = Some(["a".parse().unwrap()].into());
        let at = now();
        let token = Token { id: uuid::Uuid::nil(), name, role, rigs, created_at: at, expires_at: Some(at) };
        assert!(!token.is_in_force(at));
        assert!(token.is_in_force(at - jiff::SignedDuration::from_nanos(1)));
        assert!(token.reaches(&"a".parse().unwrap()) && !token.reaches(&"b".parse().unwrap()));
    }
}
