//! Tokens in memory. They are read again once they are half a second old, so that a request costs no
//! query and a token that another process revoked is refused within a second.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use jiff::Timestamp;

use crate::domain::{SecretDigest, Token, TokenId};
use crate::storage::{Store, StoreError, TokenTable};

/// Greatest age of the tokens in memory.
pub const MAX_AGE: Duration = Duration::from_millis(500);

/// How long a request waits while another one reads the tokens. Without a limit those that wait would find out one after
/// the other that the database is away.
const PATIENCE: Duration = Duration::from_secs(5);

/// All tokens as the store had them at one time.
#[derive(Debug)]
pub struct TokenSnapshot {
    /// Keyed by the first half of their digests; then the whole digest is compared in constant time.
    tokens: HashMap<[u8; 16], (SecretDigest, Arc<Token>)>,
    /// Revoked tokens, in the same way.
    revoked: HashMap<[u8; 16], (SecretDigest, Arc<Token>)>,
    /// Whether a token was ever made.
    pub any: bool,
}

/// A cache of the store's tokens, never older than [`MAX_AGE`].
#[derive(Debug)]
pub struct TokenCache {
    store: Store,
    held: Mutex<Option<(Instant, Arc<TokenSnapshot>)>>,
    /// One request reads the store; the others wait for its result.
    reading: tokio::sync::Mutex<()>,
}

impl TokenCache {
    /// A cache of a store's tokens.
    pub fn new(store: Store) -> Self {
        Self { store, held: Mutex::default(), reading: tokio::sync::Mutex::default() }
    }

    /// The tokens.
    ///
    /// # Errors
    /// The store's failures: tokens that are too old are not used.
    pub async fn current(&self) -> Result<Arc<TokenSnapshot>, StoreError> {
        if let Some(snapshot) = self.fresh() {
            return Ok(snapshot);
        }
        let reading = tokio::time::timeout(PATIENCE, self.reading.lock()).await;
        let _reading = reading.map_err(|_| StoreError::Silent)?;
        if let Some(snapshot) = self.fresh() {
            return Ok(snapshot);
        }
        // The age counts from before the query, which may miss changes that are made meanwhile.
        let looked = Instant::now();
        let snapshot = Arc::new(TokenSnapshot::of(self.store.token_table().await?));
        *self.held() = Some((looked, Arc::clone(&snapshot)));
        Ok(snapshot)
    }

    /// Makes the next request read the store.
    pub fn forget(&self) {
        *self.held() = None;
    }

    fn fresh(&self) -> Option<Arc<TokenSnapshot>> {
        let held = self.held();
        held.as_ref()
            .filter(|(looked, _)| looked.elapsed() < MAX_AGE)
            .map(|(_, snapshot)| Arc::clone(snapshot))
    }

    fn held(&self) -> MutexGuard<'_, Option<(Instant, Arc<TokenSnapshot>)>> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl TokenSnapshot {
    fn of(table: TokenTable) -> Self {
        let any = table.any();
        let by_half = |tokens: Vec<(SecretDigest, Token)>| {
            tokens.into_iter().map(|(digest, token)| (digest.half(), (digest, Arc::new(token)))).collect()
        };
        Self { tokens: by_half(table.tokens), revoked: by_half(table.revoked), any }
    }

    /// The token of this secret, even if it is expired or revoked: for the log, never for access.
    pub fn identify(&self, digest: &SecretDigest) -> Option<&Token> {
        let (known, token) = self.tokens.get(&digest.half()).or_else(|| self.revoked.get(&digest.half()))?;
        known.matches(digest).then_some(token)
    }

    /// The token of this secret, if it is in force.
    pub fn find(&self, digest: &SecretDigest, now: Timestamp) -> Option<Arc<Token>> {
        let (known, token) = self.tokens.get(&digest.half())?;
        (known.matches(digest) && token.is_in_force(now)).then(|| Arc::clone(token))
    }

    /// The token of this id, if it is in force.
    pub fn by_id(&self, id: TokenId, now: Timestamp) -> Option<Arc<Token>> {
        let (_, token) = self.tokens.values().find(|(_, token)| token.id == id)?;
        token.is_in_force(now).then(|| Arc::clone(token))
    }

    /// Whether a token that was found is still in force.
    pub fn holds(&self, token: &Token, now: Timestamp) -> bool {
        token.is_in_force(now) && self.tokens.values().any(|(_, known)| known.id == token.id)
    }
}

#[cfg(test)]
mod timing;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Secret, TokenDraft, TokenRole};
    use crate::storage::TokenInsert;
    use crate::storage::testing::{TestStore, now};

    async fn admin(store: &TestStore) -> (Secret, Token) {
        let draft = TokenDraft { name: String::new(), role: TokenRole::Admin, rigs: None, expires_at: None };
        let secret = Secret::draw().unwrap();
        match store.insert_token(&draft, secret.digest(), None, now()).await.unwrap() {
            TokenInsert::Inserted(token) => (secret, token),
            other => panic!("{other:?}"),
        }
    }

    #[tokio::test]
    async fn what_another_process_changes_is_seen_within_a_second() {
        let store = TestStore::open().await;
        let token_cache = TokenCache::new(store.clone());
        assert!(!token_cache.current().await.unwrap().any);
        let (secret, token) = admin(&store).await;
        let found = |snapshot: Arc<TokenSnapshot>| snapshot.find(&secret.digest(), now());
        let started = Instant::now();
        while found(token_cache.current().await.unwrap()).is_none() {
            assert!(started.elapsed() < Duration::from_secs(1));
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        let snapshot = token_cache.current().await.unwrap();
        assert!(snapshot.any && snapshot.holds(&token, now()));
        store.revoke_token(token.id, now()).await.unwrap();
        let started = Instant::now();
        while found(token_cache.current().await.unwrap()).is_some() {
            assert!(started.elapsed() < Duration::from_secs(1));
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        let snapshot = token_cache.current().await.unwrap();
        assert!(snapshot.any && !snapshot.holds(&token, now()));
        assert_eq!(snapshot.identify(&secret.digest()), Some(&token), "the log still names it");
        assert_eq!(snapshot.identify(&Secret::draw().unwrap().digest()), None);
    }

    #[tokio::test]
    async fn only_the_whole_digest_finds_a_token() {
        let store = TestStore::open().await;
        let (secret, token) = admin(&store).await;
        let snapshot = TokenCache::new(store.clone()).current().await.unwrap();
        let digest = secret.digest();
        assert_eq!(snapshot.find(&digest, now()).as_deref(), Some(&token));
        for byte in 0..32 {
            let mut other = *digest.as_bytes();
            other[byte] ^= 1;
            assert_eq!(snapshot.find(&SecretDigest::stored(other), now()), None, "byte {byte}");
        }
    }

    #[tokio::test]
    async fn a_store_that_is_closed_vouches_for_nobody() {
        let store = TestStore::open().await;
        let token_cache = TokenCache::new(store.clone());
        token_cache.current().await.unwrap();
        store.close().await;
        tokio::time::sleep(MAX_AGE).await;
        assert!(token_cache.current().await.is_err());
    }
}
