//! The tables of one service: [`Tables`].
//!
//! A table is a store of its own: with its spec, its sampler, its limiter, its folder and its committing thread. What
//! they share is the address, and the names by which streams choose between them.

use crate::config::DEFAULT_TABLE;
use crate::store::Store;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Stores by name; one is there whatever happens, and is called [`DEFAULT_TABLE`].
#[derive(Clone, Debug)]
pub struct Tables {
    stores: BTreeMap<String, Arc<Store>>,
}

/// Why a table cannot be added.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
pub enum TableError {
    /// The name is taken.
    #[error("there are two tables `{0}`: rename one")]
    Duplicate(String),
    /// The name is none.
    #[error("`{0}` cannot name a table: use 1 to 64 lower-case letters, digits, `-` and `_`")]
    Name(String),
}

impl From<Arc<Store>> for Tables {
    fn from(store: Arc<Store>) -> Self {
        Self { stores: BTreeMap::from([(DEFAULT_TABLE.to_owned(), store)]) }
    }
}

impl Tables {
    /// With another table of this name.
    ///
    /// # Errors
    /// [`TableError`] if the name is taken, or none.
    pub fn with(mut self, name: &str, store: Arc<Store>) -> Result<Self, TableError> {
        check_table_name(name)?;
        if self.stores.insert(name.to_owned(), store).is_some() {
            return Err(TableError::Duplicate(name.to_owned()));
        }
        Ok(self)
    }

    /// By name, in the order of the names.
    pub(crate) fn into_stores(self) -> BTreeMap<String, Arc<Store>> {
        self.stores
    }
}

/// Whether a table can have this name.
///
/// # Errors
/// [`TableError::Name`], if it cannot.
pub fn check_table_name(name: &str) -> Result<(), TableError> {
    let allowed = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || b"-_".contains(&byte);
    if (1..=64).contains(&name.len()) && name.bytes().all(allowed) {
        Ok(())
    } else {
        Err(TableError::Name(name.to_owned()))
    }
}
