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
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

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

    /// Welch's t of two samples, each without its slowest hundredth, which the machine made.
    fn welch_t(mut samples: [Vec<f64>; 2]) -> f64 {
        let [a, b] = &mut samples;
        let moments = |times: &mut Vec<f64>| {
            times.sort_unstable_by(f64::total_cmp);
            times.truncate(times.len() * 99 / 100);
            let n = times.len() as f64;
            let mean = times.iter().sum::<f64>() / n;
            (mean, times.iter().map(|t| (t - mean).powi(2)).sum::<f64>() / (n - 1.0) / n)
        };
        let ((mean_a, var_a), (mean_b, var_b)) = (moments(a), moments(b));
        (mean_a - mean_b) / (var_a + var_b).sqrt()
    }

    #[tokio::test]
    async fn the_time_of_a_refusal_does_not_tell_how_much_of_a_secret_is_right() {
        let store = TestStore::open().await;
        let (secret, _) = admin(&store).await;
        let keys = Keyring::new(store.clone()).current().await.unwrap();
        let (mut rng, at) = (ChaCha8Rng::seed_from_u64(1), now());
        let nearly = format!("{}!", &secret.reveal()[..secret.reveal().len() - 1]);
        // A machine that others use may shift one round in ten thousand; not three.
        let mut found = Vec::new();
        for _ in 0..3 {
            let mut times = [Vec::new(), Vec::new()];
            for _ in 0..100_000 {
                let right = rng.random::<bool>();
                // Both are made anew, so that neither is nearer to the processor.
                let texts = [format!("rigcast_{:043}", rng.random::<u64>()), nearly.clone()];
                let shown = &texts[usize::from(right)];
                let started = Instant::now();
                let refused = keys.find(&SecretDigest::of(shown.as_bytes()), at).is_none();
                times[usize::from(right)].push(started.elapsed().as_nanos() as f64);
                assert!(refused);
            }
            found.push(welch_t(times));
        }
        println!("Welch's t of a secret that is nearly right against any other: {found:.1?}");
        assert!(found.iter().any(|t| t.abs() < 4.5), "{found:?}");
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
