//! What every benchmark shares: its rows, the table it prints and the file it leaves in `target/bench/`.

use std::fs;
use std::path::Path;

use serde::Serialize;

/// One measurement. Higher is better; what a row does not have is null in the file.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Row {
    /// What was measured.
    pub(crate) name: String,
    /// Unit of `ours`, `peer` and `limit`.
    pub(crate) unit: String,
    /// What this project reaches.
    pub(crate) ours: f64,
    /// What the peer reaches on the same machine.
    pub(crate) peer: Option<f64>,
    /// What the machine allows.
    pub(crate) limit: Option<f64>,
    /// `ours` over `peer`.
    pub(crate) ratio_to_peer: Option<f64>,
    /// `ours` over `limit`.
    pub(crate) share_of_limit: Option<f64>,
}

/// Prints the rows as a table and writes them to `target/bench/NAME.json`.
pub(crate) fn report(name: &str, rows: &[Row]) -> anyhow::Result<()> {
    let number = |value: Option<f64>, decimals: usize| {
        value.map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}"))
    };
    println!(
        "{:<36} {:<18} {:>12} {:>12} {:>12} {:>8} {:>8}",
        name, "unit", "ours", "peer", "limit", "of peer", "of limit"
    );
    for row in rows {
        let [ours, peer, limit] = [Some(row.ours), row.peer, row.limit].map(|value| number(value, 1));
        let [of_peer, of_limit] = [row.ratio_to_peer, row.share_of_limit].map(|value| number(value, 3));
        println!(
            "{:<36} {:<18} {ours:>12} {peer:>12} {limit:>12} {of_peer:>8} {of_limit:>8}",
            row.name, row.unit
        );
    }
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/bench");
    fs::create_dir_all(&folder)?;
    let file = folder.join(format!("{name}.json"));
    fs::write(&file, serde_json::to_string_pretty(rows)? + "\n")?;
    println!("written to {}", file.display());
    Ok(())
}

/// The median: half of the values are below it.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    assert!(!values.is_empty(), "a median of nothing");
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
