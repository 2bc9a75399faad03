//! `getup certs`: certificates for a cluster that has no authority of its own.

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use getup_transport::{Issued, generate_token, make_authority};

use crate::output::say;

/// Make an authority and a certificate that all roles of a cluster share, for mutual TLS.
///
/// DIR gets ca.pem, ca.key, peer.pem and peer.key. Give the roles `security.ca=DIR/ca.pem`,
/// `security.certificate=DIR/peer.pem` and `security.key=DIR/peer.key`, and keep ca.key to yourself. Called again it
/// renews peer.pem and keeps the authority; running roles take the new files up by themselves.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Where the files go.
    dir: PathBuf,
    /// A host name or address by which a role is reached, such as replay; may be repeated. localhost is always there.
    #[arg(long = "name", value_name = "HOST")]
    names: Vec<String>,
    /// Where ca.key is kept, away from what the roles can read. [default: DIR]
    #[arg(long, value_name = "DIR")]
    authority: Option<PathBuf>,
    /// Leave a certificate that is valid for these names, and for another month, as it is.
    #[arg(long)]
    if_missing: bool,
    /// Also make DIR/token, a secret for security.token_file, where there is none.
    #[arg(long)]
    token: bool,
}

pub(crate) fn run(arguments: Args) -> Result<()> {
    let dir = &arguments.dir;
    let vault = arguments.authority.as_ref().unwrap_or(dir);
    let issued = make_authority(dir, vault, &arguments.names, arguments.if_missing)?;
    let shown = dir.display();
    let token = dir.join("token");
    let makes_token = arguments.token && !token.exists();
    if makes_token {
        write_secret(dir, &token).with_context(|| format!("cannot write {}", token.display()))?;
    }
    say!(
        "{}",
        match issued {
            Issued::Nothing => format!("{shown}/peer.pem is valid: nothing to do"),
            Issued::Peer => format!("{shown}/peer.pem is new, from the authority that was there"),
            Issued::AuthorityAndPeer => format!("{shown}/ca.pem and {shown}/peer.pem are new"),
        }
    );
    if makes_token {
        say!("{} is new", token.display());
    }
    Ok(())
}

/// Writes a token whole or not at all, for its owner's eyes alone.
fn write_secret(dir: &Path, path: &Path) -> std::io::Result<()> {
    // Such files are their owner's from the beginning.
    let mut file = tempfile::NamedTempFile::new_in(dir)?;
    writeln!(file, "{}", generate_token())?;
    file.as_file().sync_all()?;
    file.persist_noclobber(path)?;
    Ok(())
}
