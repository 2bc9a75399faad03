//! Certificates that are made here.

use std::os::unix::fs::PermissionsExt;

use crate::support::Folder;
use getup_transport::{Credentials, Issued, make_authority};

fn names(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

#[test]
fn an_authority_is_made_once_and_issues_again_and_again() {
    let folder = Folder::new();
    let issue = |named: &[&str]| make_authority(folder.path(), folder.path(), &names(named), false).unwrap();
    assert_eq!(issue(&["replay", "*.actors.example", "10.0.0.5"]), Issued::AuthorityAndPeer);
    let (authority, peer) = (folder.text("ca.pem"), folder.text("peer.pem"));
    assert_eq!(issue(&[]), Issued::Peer);
    assert_eq!(folder.text("ca.pem"), authority);
    assert_ne!(folder.text("peer.pem"), peer);
    Credentials::load(&folder.tls()).unwrap();
    // No more than the four files are left.
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 4);
}

#[test]
fn keys_are_for_their_owner_alone() {
    let folder = Folder::new();
    let (new, vault) = (folder.path().join("new/folder"), folder.path().join("vault"));
    make_authority(&new, &vault, &[], false).unwrap();
    assert!(vault.join("ca.key").exists() && !new.join("ca.key").exists());
    assert_eq!(
        make_authority(&new, &vault, &[], false).unwrap(),
        Issued::Peer,
        "the authority is found again"
    );
    let mode = |path: std::path::PathBuf| path.metadata().unwrap().permissions().mode() & 0o777;
    assert_eq!([mode(vault.join("ca.key")), mode(new.join("peer.key"))], [0o600, 0o600]);
    assert_eq!(mode(new.join("peer.pem")) & 0o600, 0o600);
}

#[test]
fn nothing_is_done_while_the_certificate_is_good_for_all_names() {
    let folder = Folder::new();
    let issue = |named: &[&str]| make_authority(folder.path(), folder.path(), &names(named), true).unwrap();
    assert_eq!(issue(&["replay"]), Issued::AuthorityAndPeer);
    let peer = folder.text("peer.pem");
    assert_eq!((issue(&["replay"]), issue(&[])), (Issued::Nothing, Issued::Nothing));
    assert_eq!(folder.text("peer.pem"), peer);
    assert_eq!(issue(&["replay", "learner"]), Issued::Peer);
    // A key that does not belong to it is as none.
    folder.write("peer.key", folder.text("ca.key"));
    assert_eq!(issue(&["learner"]), Issued::Peer);
    // A peer's own folder has no key of the authority, and needs none.
    std::fs::remove_file(folder.path().join("ca.key")).unwrap();
    assert_eq!(issue(&["learner"]), Issued::Nothing);
}

#[test]
fn an_authority_that_lost_its_certificate_gets_one_that_its_peers_believe() {
    let folder = Folder::new();
    make_authority(folder.path(), folder.path(), &[], false).unwrap();
    std::fs::remove_file(folder.path().join("ca.pem")).unwrap();
    let peer = [folder.text("peer.pem"), folder.text("peer.key")];
    make_authority(folder.path(), folder.path(), &[], false).unwrap();
    folder.write("peer.pem", &peer[0]);
    folder.write("peer.key", &peer[1]);
    assert_eq!(make_authority(folder.path(), folder.path(), &[], true).unwrap(), Issued::Nothing);
}

#[test]
fn what_cannot_be_issued_is_refused_with_the_way_out() {
    let (folder, other) = (Folder::new(), Folder::new());
    let refused = |named: &[&str]| {
        make_authority(folder.path(), folder.path(), &names(named), false).unwrap_err().to_string()
    };
    let error = refused(&["no name"]);
    assert!(error.contains("\"no name\" is neither a DNS name nor an IP address"), "{error}");
    make_authority(folder.path(), folder.path(), &[], false).unwrap();
    make_authority(other.path(), other.path(), &[], false).unwrap();
    let peer = folder.text("peer.pem");
    folder.write("ca.key", other.text("ca.key"));
    let error = refused(&[]);
    assert!(error.contains("ca.pem cannot issue certificates"), "{error}");
    folder.write("ca.key", "no key");
    let error = refused(&[]);
    assert!(error.contains("ca.key cannot issue certificates"), "{error}");
    std::fs::remove_file(folder.path().join("ca.key")).unwrap();
    let error = refused(&[]);
    assert!(error.contains("ca.key is not: issue certificates where the key is"), "{error}");
    assert_eq!(folder.text("peer.pem"), peer);
}
