//! Where a service is, and what it wants to be shown.

use crate::{AddressError, Channel, ChannelOptions, Credentials, Network};

/// A service of another role.
#[derive(Clone, Debug, Default)]
pub struct Endpoint {
    /// `host:port`.
    pub address: String,
    /// What this process shows there.
    pub credentials: Credentials,
    /// How it is reached.
    pub network: Network,
}

impl Endpoint {
    /// The service at this address, by TCP.
    pub fn new(address: &str, credentials: &Credentials) -> Self {
        Self { address: address.to_owned(), credentials: credentials.clone(), network: Network::default() }
    }

    /// As [`Credentials::channel`].
    ///
    /// # Errors
    /// [`AddressError`], for what is no address.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn channel(&self, options: ChannelOptions) -> Result<Channel, AddressError> {
        self.credentials.channel_through(&self.network, &self.address, options)
    }
}

/// An open port.
impl From<&str> for Endpoint {
    fn from(address: &str) -> Self {
        Self::new(address, &Credentials::default())
    }
}

/// An open port.
impl From<&String> for Endpoint {
    fn from(address: &String) -> Self {
        address.as_str().into()
    }
}
