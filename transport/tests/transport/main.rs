//! Certificates, tokens and limits of ports, over real connections.

mod certs;
mod files;
mod limits;
mod support;
mod tls;
mod token;
