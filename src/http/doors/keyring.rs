//! The tokens in memory: read from the store again before they are half a second old, so that a
//! request costs no query, and a token that another process revoked opens nothing a second later.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use jiff::Timestamp;

use crate::domain::{SecretDigest, Token};
use crate::storage::{Store, StoreError, TokenTable};

/// How old what is known of the tokens may be.
pub const MAX_AGE: Duration = Duration::from_millis(500);

/// All tokens as the store had them.
#[derive(Debug)]
pub struct Keys {
    /// By one half of their digests; the other half is compared.
    tokens: HashMap<[u8; 16], (SecretDigest, Arc<Token>)>,
    /// Whether there ever was one.
    pub any: bool,
}

/// The tokens, as fresh as they must be.
#[derive(Debug)]
pub struct Keyring {
    store: Store,
    held: Mutex<Option<(Instant, Arc<Keys>)>>,
    /// One reads, the others wait for what it finds.
    reading: tokio::sync::Mutex<()>,
}

impl Keyring {
    /// The tokens of a store.
    pub fn new(store: Store) -> Self {
        Self { store, held: Mutex::default(), reading: tokio::sync::Mutex::default() }
    }

    /// The tokens.
    ///
    /// # Errors
    /// The store's failures: tokens that are too old are not used.
    pub async fn current(&self) -> Result<Arc<Keys>, StoreError> {
        if let Some(keys) = self.fresh() {
            return Ok(keys);
        }
        let _reading = self.reading.lock().await;
        if let Some(keys) = self.fresh() {
            return Ok(keys);
        }
        // Their age counts from before the look: what changes meanwhile may be missed by it.
        let looked = Instant::now();
        let keys = Arc::new(Keys::of(self.store.token_table().await?));
        *self.held() = Some((looked, Arc::clone(&keys)));
        Ok(keys)
    }

    /// Reads them anew for whoever asks next.
    pub fn forget(&self) {
        *self.held() = None;
    }

    fn fresh(&self) -> Option<Arc<Keys>> {
        let held = self.held();
        held.as_ref().filter(|(looked, _)| looked.elapsed() < MAX_AGE).map(|(_, keys)| Arc::clone(keys))
    }

    fn held(&self) -> MutexGuard<'_, Option<(Instant, Arc<Keys>)>> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Keys {
    fn of(table: TokenTable) -> Self {
        let tokens = table.tokens.into_iter();
        let tokens = tokens.map(|(digest, token)| (digest.half(), (digest, Arc::new(token)))).collect();
        Self { tokens, any: table.any }
    }

    /// The token of this secret, if it is in force.
    pub fn find(&self, digest: &SecretDigest, now: Timestamp) -> Option<Arc<Token>> {
        let (known, token) = self.tokens.get(&digest.half())?;
        (known.matches(digest) && token.is_in_force(now)).then(|| Arc::clone(token))
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
        match store.insert_token(&draft, secret.digest(), now()).await.unwrap() {
            TokenInsert::Inserted(token) => (secret, token),
            other => panic!("{other:?}"),
        }
    }

    #[tokio::test]
    async fn what_another_process_changes_is_seen_within_a_second() {
        let store = TestStore::open().await;
        let keyring = Keyring::new(store.clone());
        assert!(!keyring.current().await.unwrap().any);
        let (secret, token) = admin(&store).await;
        let found = |keys: Arc<Keys>| keys.find(&secret.digest(), now());
        let started = Instant::now();
        while found(keyring.current().await.unwrap()).is_none() {
            assert!(started.elapsed() < Duration::from_secs(1));
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        let keys = keyring.current().await.unwrap();
        assert!(keys.any && keys.holds(&token, now()));
        store.revoke_token(token.id, now()).await.unwrap();
        let started = Instant::now();
        while found(keyring.current().await.unwrap()).is_some() {
            assert!(started.elapsed() < Duration::from_secs(1));
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        let keys = keyring.current().await.unwrap();
        assert!(keys.any && !keys.holds(&token, now()));
    }

    #[tokio::test]
    async fn only_the_whole_digest_finds_a_token() {
        let store = TestStore::open().await;
        let (secret, token) = admin(&store).await;
        let keys = Keyring::new(store.clone()).current().await.unwrap();
        let digest = secret.digest();
        assert_eq!(keys.find(&digest, now()).as_deref(), Some(&token));
        for byte in 0..32 {
            let mut other = *digest.as_bytes();
            other[byte] ^= 1;
            assert_eq!(keys.find(&SecretDigest::stored(other), now()), None, "byte {byte}");
        }
    }

    #[tokio::test]
    async fn a_store_that_is_closed_vouches_for_nobody() {
        let store = TestStore::open().await;
        let keyring = Keyring::new(store.clone());
        keyring.current().await.unwrap();
        store.close().await;
        tokio::time::sleep(MAX_AGE).await;
        assert!(keyring.current().await.is_err());
    }
}
