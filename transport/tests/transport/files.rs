//! Files of `[security]` that are not what they should be, and secrets that stay in theirs.

use crate::support::Folder;
use getup_telemetry::Registry;
use getup_transport::{
    ChannelOptions, Credentials, Limits, Metrics, SecurityConfig, Server, generate_token, make_authority,
};

#[test]
fn a_file_that_cannot_be_used_is_named_with_its_setting_and_the_way_out() {
    let (folder, other) = (Folder::new(), Folder::new());
    make_authority(folder.path(), folder.path(), &[], false).unwrap();
    make_authority(other.path(), other.path(), &[], false).unwrap();
    let good = folder.tls();
    let junk = folder.write("junk", "not PEM");
    let wrong = [
        ("ca", SecurityConfig { ca: "missing.pem".into(), ..good.clone() }, "cannot read"),
        ("ca", SecurityConfig { ca: junk.clone(), ..good.clone() }, "holds no certificate in PEM"),
        ("certificate", SecurityConfig { certificate: junk.clone(), ..good.clone() }, "no certificate"),
        ("key", SecurityConfig { key: junk.clone(), ..good.clone() }, "holds no private key in PEM"),
        ("certificate", SecurityConfig { key: other.tls().key, ..good.clone() }, "do they belong together?"),
        ("token_file", SecurityConfig { token_file: "missing".into(), ..good.clone() }, "`getup certs`"),
        ("token_file", SecurityConfig { token_file: junk.clone(), ..good.clone() }, "`getup certs --token`"),
        ("metrics_token_file", SecurityConfig { metrics_token_file: junk, ..good.clone() }, "number 1"),
    ];
    for (setting, config, says) in wrong {
        let error = Credentials::load(&config).unwrap_err().to_string();
        let path = match setting {
            "ca" => &config.ca,
            "certificate" => &config.certificate,
            "key" => &config.key,
            "token_file" => &config.token_file,
            _ => &config.metrics_token_file,
        };
        assert!(error.contains(&format!("security.{setting} = {path:?}")), "{error}");
        assert!(error.contains(says), "{error}");
    }
    let incomplete = SecurityConfig { key: Default::default(), ..good };
    let error = Credentials::load(&incomplete).unwrap_err().to_string();
    assert!(error.contains("security.key is not"), "{error}");
}

#[tokio::test]
async fn nothing_that_can_be_printed_shows_a_secret() {
    let folder = Folder::new();
    make_authority(folder.path(), folder.path(), &[], false).unwrap();
    let token = generate_token();
    let config = SecurityConfig { token_file: folder.write("token", &token), ..folder.tls() };
    let credentials = Credentials::load(&config).unwrap();
    let channel = credentials.channel("localhost:7400", ChannelOptions::default()).unwrap();
    let metrics = Metrics::new(&Registry::new());
    let printed =
        format!("{config:?} {channel:?} {:?}", Server::new(credentials, Limits::default(), metrics));
    let key = folder.text("peer.key");
    let key = key.lines().nth(1).unwrap();
    assert!(printed.contains("Credentials { token: true, tls: true, metrics_token: false }"), "{printed}");
    assert!(!printed.contains(&token) && !printed.contains(key), "{printed}");
}
