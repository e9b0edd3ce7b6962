//! Tokens in the store. Secrets come as digests only.

use jiff::Timestamp;

use super::database::sql;
use super::idempotency::{check_unused, record};
use super::reserve::with_reserve;
use super::rows::{TokenRow, all, json, us};
use super::{IdempotencyKey, Store, StoreError};
use crate::domain::{Created, Page, PageRequest, SecretDigest, Token, TokenDraft, TokenId, new_id};

/// Outcome of creating a token.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum TokenInsert {
    /// The token.
    Inserted(Token),
    /// There is none yet, and the first one must be an admin's for all rigs: it closes the service to
    /// everybody else, so its holder must be able to create others.
    FirstMustBeAdmin,
}

/// All tokens that were ever made, each with the digest by which it is found.
#[derive(Debug, Default)]
pub struct TokenTable {
    /// Tokens that are not revoked; some may have expired.
    pub tokens: Vec<(SecretDigest, Token)>,
    /// Revoked tokens: refused, but still named in the log.
    pub revoked: Vec<(SecretDigest, Token)>,
}

impl TokenTable {
    /// Whether a token was ever made.
    pub fn any(&self) -> bool {
        !(self.tokens.is_empty() && self.revoked.is_empty())
    }
}

impl Store {
    /// Adds a token. The draft must have passed its check.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn insert_token(
        &self,
        draft: &TokenDraft,
        secret: SecretDigest,
        key: Option<&IdempotencyKey>,
        now: Timestamp,
    ) -> Result<TokenInsert, StoreError> {
        let mut tx = self.write().await?;
        check_unused(&mut tx, key).await?;
        let any: bool = sql("SELECT EXISTS (SELECT 1 FROM tokens)").fetch_one(&mut *tx).await?;
        if !any && !draft.may_be_first() {
            return Ok(TokenInsert::FirstMustBeAdmin);
        }
        let row: TokenRow =
            sql("INSERT INTO tokens (id, name, role, rigs, secret_sha256, created_us, expires_us)
             VALUES ($1, $2, $3, $4, $5, $6, $7) RETURNING *")
            .bind(new_id(now).to_string())
            .bind(&draft.name)
            .bind(draft.role.as_str())
            .bind(draft.rigs.as_ref().map(json))
            .bind(&secret.as_bytes()[..])
            .bind(us(now))
            .bind(draft.expires_at.map(us))
            .fetch_one(&mut *tx)
            .await?;
        let token: Token = row.try_into()?;
        record(&mut tx, key, || Created::token(&token), now).await?;
        tx.commit().await?;
        Ok(TokenInsert::Inserted(token))
    }

    /// Tokens that are not revoked, oldest first.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn tokens(&self, page: &PageRequest) -> Result<Page<Token>, StoreError> {
        let rows: Vec<TokenRow> =
            sql("SELECT * FROM tokens WHERE revoked_us IS NULL AND id > $1 ORDER BY id LIMIT $2")
                .bind(page.cursor.as_ref().map_or("", |cursor| cursor.as_str()))
                .bind(i64::from(page.limit) + 1)
                .fetch_all(self.reader())
                .await?;
        Ok(Page::cut(all(rows)?, page.limit, |token: &Token| token.id.to_string()))
    }

    /// All tokens that were ever made, by their digests.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn token_table(&self) -> Result<TokenTable, StoreError> {
        let rows: Vec<TokenRow> = sql("SELECT * FROM tokens").fetch_all(self.reader()).await?;
        let mut table = TokenTable::default();
        for row in rows {
            let list = if row.is_revoked() { &mut table.revoked } else { &mut table.tokens };
            list.push((row.digest()?, row.try_into()?));
        }
        Ok(table)
    }

    /// Revokes a token; tells whether there was one to revoke.
    ///
    /// # Errors
    /// The store's failures.
    pub async fn revoke_token(&self, id: TokenId, now: Timestamp) -> Result<bool, StoreError> {
        with_reserve!(self, self.revoke_token_row(id, now))
    }

    async fn revoke_token_row(&self, id: TokenId, now: Timestamp) -> Result<bool, StoreError> {
        let mut tx = self.write_with_reserve().await?;
        let done = sql("UPDATE tokens SET revoked_us = $2 WHERE id = $1 AND revoked_us IS NULL")
            .bind(id.to_string())
            .bind(us(now))
            .execute(&mut *tx)
            .await?;
        tx.commit().await?;
        Ok(done == 1)
    }
}

#[cfg(test)]
mod tests {
    use jiff::ToSpan;

    use super::super::testing::{TestStore, now};
    use super::*;
    use crate::domain::{Secret, TokenRole};

    fn draft(role: TokenRole) -> TokenDraft {
        TokenDraft { name: "n".into(), role, rigs: None, expires_at: None }
    }

    async fn insert(store: &TestStore, draft: &TokenDraft) -> Option<(Secret, Token)> {
        let secret = Secret::draw().unwrap();
        match store.insert_token(draft, secret.digest(), None, now()).await.unwrap() {
            TokenInsert::Inserted(token) => Some((secret, token)),
            TokenInsert::FirstMustBeAdmin => None,
        }
    }

    #[tokio::test]
    async fn the_first_token_is_an_admins_and_a_revoked_one_keeps_the_doors_closed() {
        let store = TestStore::open().await;
        assert!(!store.token_table().await.unwrap().any());
        assert!(insert(&store, &draft(TokenRole::Operator)).await.is_none());
        let (_, admin) = insert(&store, &draft(TokenRole::Admin)).await.unwrap();
        let rigs = Some(["a".parse().unwrap(), "b".parse().unwrap()].into());
        let wanted = TokenDraft { rigs, expires_at: Some(now() + 1.hour()), ..draft(TokenRole::Reader) };
        let (secret, reader) = insert(&store, &wanted).await.unwrap();
        assert_eq!(
            (&reader.rigs, reader.expires_at, reader.role),
            (&wanted.rigs, wanted.expires_at, wanted.role)
        );

        let listed = store.tokens(&PageRequest::default()).await.unwrap().items;
        assert_eq!(listed, [admin.clone(), reader.clone()]);
        let table = store.token_table().await.unwrap();
        let found = table.tokens.iter().find(|(digest, _)| digest.matches(&secret.digest())).unwrap();
        assert_eq!((&found.1, table.any()), (&reader, true));

        for id in [admin.id, reader.id] {
            assert!(store.revoke_token(id, now()).await.unwrap());
            assert!(!store.revoke_token(id, now()).await.unwrap(), "once");
        }
        let table = store.token_table().await.unwrap();
        let revoked: Vec<&Token> = table.revoked.iter().map(|(_, token)| token).collect();
        assert_eq!((table.tokens.len(), revoked, table.any()), (0, vec![&admin, &reader], true));
        assert_eq!(store.tokens(&PageRequest::default()).await.unwrap().items, []);
    }

    #[tokio::test]
    async fn no_file_of_the_store_holds_a_secret() {
        let store = TestStore::open().await;
        let (secret, _) = insert(&store, &draft(TokenRole::Admin)).await.unwrap();
        let mut read = 0;
        for entry in std::fs::read_dir(store.data_dir()).unwrap() {
            let path = entry.unwrap().path();
            if path.is_file() {
                let bytes = std::fs::read(&path).unwrap();
                read += bytes.len();
                let text = secret.reveal().strip_prefix("rigcast_").unwrap().as_bytes();
                assert!(!bytes.windows(text.len()).any(|w| w == text), "{}", path.display());
            }
        }
        assert!(read > 10_000, "the database and its journal were read");
    }
}
