//! How the roles reach each other, and nothing else: channels, the accept loop, TLS, tokens and limits.
//!
//! A role loads its [`Credentials`] once. They make its channels to others and stand at its own port, so that both
//! ends agree: mutual TLS where there are certificates, a token where there is one, both, or neither on a loopback.
//! All files are read again when they change: no process has to be restarted for a new certificate or token, and
//! streams that are open stay open.
//!
//! | module | what it gives |
//! | --- | --- |
//! | [`config`] | [`SecurityConfig`]: what an operator sets; [`require_protection`] for ports that others reach |
//! | [`credentials`] | [`Credentials`]: the files of the configuration, read |
//! | [`channel`] | [`Channel`]: a client's lazy connection, with token and TLS; its [`ChannelOptions`] |
//! | [`endpoint`] | [`Endpoint`]: an address with the credentials that are shown there |
//! | [`network`] | [`Listener`] and [`Network`]: TCP, or what a simulation puts in its place |
//! | [`server`] | [`Server`]: a port with TLS, token and [`Limits`] in front of its services |
//! | [`metrics`] | [`Metrics`]: connections, and those that were refused |
//! | [`token`] | [`generate_token`]: a secret that whoever calls has to know |
//! | [`certs`] | [`make_authority`]: certificates for a cluster that has no authority of its own |

pub mod certs;
pub mod channel;
pub mod config;
mod connection;
pub mod credentials;
mod door;
pub mod endpoint;
mod error;
pub mod metrics;
pub mod network;
mod reload;
mod seats;
pub mod server;
mod throttle;
mod tls;
pub mod token;

pub use certs::{CertsError, Issued, make_authority};
pub use channel::{Bearer, Channel, ChannelOptions, Window, is_final, reason};
pub use config::{SecurityConfig, require_protection};
pub use credentials::Credentials;
pub use endpoint::Endpoint;
pub use error::{AddressError, SecurityError};
pub use metrics::Metrics;
pub use network::{Listener, Network};
pub use server::{Limits, Server};
pub use token::generate_token;
