//! What each image holds: a CycloneDX document an image, from what cargo resolves for it and from the pinned wheels.
//!
//! The same sources give the same file: it has no date and no number of its own.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::process::Command;

use anyhow::{Context, Result, bail};
use serde_json::{Value, json};

use crate::native::{CUDA_WHEELS, WHEELS, root};
use crate::tasks::cargo;

/// An image of `deploy/Dockerfile`.
struct Image {
    name: &'static str,
    /// What of getup is built for it.
    features: &'static str,
    /// The wheels whose libraries it holds.
    wheels: &'static [&'static [&'static str]],
}

const IMAGES: [Image; 3] = [
    Image { name: "slim", features: "", wheels: &[WHEELS.split_at(1).0] },
    Image { name: "learner", features: "learner", wheels: &[WHEELS] },
    Image { name: "learner-cuda", features: "learner", wheels: &[WHEELS, CUDA_WHEELS] },
];
/// What every image has of Debian, in the version of the day on which it is built.
const DEBIAN: [(&str, &str); 4] = [
    ("ca-certificates", "MPL-2.0"),
    ("libc6", "LGPL-2.1-or-later"),
    ("libgcc-s1", "GPL-3.0-or-later WITH GCC-exception-3.1"),
    ("libstdc++6", "GPL-3.0-or-later WITH GCC-exception-3.1"),
];

/// A crate by its name and its version.
type Package = (String, String);

/// What cargo says of a crate.
struct About {
    /// Whether it is one of ours.
    is_own: bool,
    license: String,
    repository: String,
}

/// A tree of crates, as `cargo tree` prints it.
#[derive(Default)]
struct Tree {
    packages: BTreeMap<Package, About>,
    dependencies: BTreeMap<Package, BTreeSet<Package>>,
}

/// Writes `target/sbom/IMAGE.cdx.json` for every image.
pub(crate) fn write() -> Result<()> {
    let folder = root().join("target/sbom");
    fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
    for image in IMAGES {
        let document = document(&image)?;
        let file = folder.join(format!("{}.cdx.json", image.name));
        fs::write(&file, format!("{document:#}\n"))
            .with_context(|| format!("cannot write {}", file.display()))?;
        let parts = document["components"].as_array().map_or(0, Vec::len);
        println!("{}: {parts} components", file.display());
    }
    Ok(())
}

fn document(image: &Image) -> Result<Value> {
    let built = Tree::of(image.features, "normal,build")?;
    let linked = Tree::of(image.features, "normal,no-proc-macro")?;
    let checksums = checksums()?;
    let mut components = Vec::new();
    for (package, about) in &built.packages {
        let (name, version) = package;
        let mut component = json!({
            "type": "library",
            "bom-ref": reference(package),
            "name": name,
            "version": version,
            // Procedural macros and what build scripts use are no part of the program.
            "scope": if linked.packages.contains_key(package) { "required" } else { "excluded" },
            "licenses": [{ "expression": about.license }],
        });
        if !about.is_own {
            component["purl"] = reference(package).into();
        }
        if let Some(checksum) = checksums.get(package) {
            component["hashes"] = json!([{ "alg": "SHA-256", "content": checksum }]);
        }
        if !about.repository.is_empty() {
            component["externalReferences"] = json!([{ "type": "vcs", "url": about.repository }]);
        }
        components.push(component);
    }
    let version = env!("CARGO_PKG_VERSION");
    let mut of_image: Vec<String> = vec![reference(&("getup".into(), version.into()))];
    for wheel in image.wheels.concat() {
        let (name, version) = wheel.split_once("==").context("a wheel has no version")?;
        let purl = format!("pkg:pypi/{name}@{version}");
        of_image.push(purl.clone());
        components.push(json!({
            "type": "library",
            "bom-ref": purl,
            "name": name,
            "version": version,
            "scope": "required",
            "licenses": [{ "expression": wheel_license(name)? }],
            "purl": purl,
        }));
    }
    for (name, license) in DEBIAN {
        let purl = format!("pkg:deb/debian/{}?arch=amd64&distro=bookworm", encoded(name));
        of_image.push(purl.clone());
        components.push(json!({
            "type": "library",
            "bom-ref": purl,
            "name": name,
            "scope": "required",
            "licenses": [{ "expression": license }],
            "purl": purl,
        }));
    }
    let image = format!("getup-{}", image.name);
    let mut dependencies = vec![json!({ "ref": image, "dependsOn": of_image })];
    dependencies.extend(built.packages.keys().map(|package| {
        let on: Vec<String> = built.dependencies.get(package).into_iter().flatten().map(reference).collect();
        json!({ "ref": reference(package), "dependsOn": on })
    }));
    Ok(json!({
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {
            "tools": { "components": [{ "type": "application", "name": "cargo xtask sbom", "version": version }] },
            "component": {
                "type": "container",
                "bom-ref": image,
                "name": image,
                "version": version,
                "licenses": [{ "expression": env!("CARGO_PKG_LICENSE") }],
            },
        },
        "components": components,
        "dependencies": dependencies,
    }))
}

impl Tree {
    /// What a getup with these features is made of, along edges of these kinds.
    fn of(features: &str, edges: &str) -> Result<Self> {
        let mut command: Command = cargo();
        command.args([
            "tree",
            "--locked",
            "--package",
            "getup",
            "--no-default-features",
            "--features",
            features,
        ]);
        command.args(["--target", "x86_64-unknown-linux-gnu", "--prefix", "depth"]);
        command.args(["--format", "|{p}|{l}|{r}|", "--edges", edges]);
        let output = command.output().with_context(|| format!("cannot start {command:?}"))?;
        if !output.status.success() {
            bail!("{command:?} ended with {}: {}", output.status, String::from_utf8_lossy(&output.stderr));
        }
        Self::parse(&String::from_utf8(output.stdout)?)
    }

    /// Reads `DEPTH|NAME vVERSION (…)|LICENCE|REPOSITORY|` a line; what is under a crate stands there once.
    fn parse(text: &str) -> Result<Self> {
        let mut tree = Self::default();
        let mut path: Vec<Package> = Vec::new();
        for line in text.lines() {
            let fields: Vec<&str> = line.split('|').collect();
            let [depth, package, license, repository, _] = fields[..] else {
                bail!("cargo tree says {line:?}");
            };
            let mut words = package.split(' ');
            let (Some(name), Some(version)) = (words.next(), words.next().and_then(|v| v.strip_prefix('v')))
            else {
                bail!("cargo tree names a crate {package:?}");
            };
            if license.is_empty() {
                bail!("{name} {version} names no licence");
            }
            let package: Package = (name.into(), version.into());
            path.truncate(depth.parse().with_context(|| format!("cargo tree says {line:?}"))?);
            if let Some(parent) = path.last() {
                tree.dependencies.entry(parent.clone()).or_default().insert(package.clone());
            }
            let about = About {
                is_own: words.any(|word| word.starts_with("(/")),
                // Crates from before SPDX's expressions wrote `/` for `OR`.
                license: license.split('/').map(str::trim).collect::<Vec<_>>().join(" OR "),
                repository: repository.into(),
            };
            tree.packages.entry(package.clone()).or_insert(about);
            path.push(package);
        }
        Ok(tree)
    }
}

/// The checksums of `Cargo.lock`.
fn checksums() -> Result<BTreeMap<Package, String>> {
    let file = root().join("Cargo.lock");
    let text = fs::read_to_string(&file).with_context(|| format!("cannot read {}", file.display()))?;
    let lock: toml::Table = text.parse().with_context(|| format!("cannot read {}", file.display()))?;
    let packages =
        lock.get("package").and_then(toml::Value::as_array).context("Cargo.lock has no packages")?;
    let field = |package: &toml::Value, name: &str| package.get(name)?.as_str().map(str::to_owned);
    Ok(packages
        .iter()
        .filter_map(|package| {
            Some(((field(package, "name")?, field(package, "version")?), field(package, "checksum")?))
        })
        .collect())
}

/// A crate's name in the document, which is its package URL.
fn reference((name, version): &Package) -> String {
    format!("pkg:cargo/{name}@{}", encoded(version))
}

/// What a package URL takes in a name or a version.
fn encoded(text: &str) -> String {
    text.replace('+', "%2B")
}

/// A wheel's licence, as its metadata or, where they say nothing better, its licence file has it.
fn wheel_license(name: &str) -> Result<&'static str> {
    Ok(match name {
        "mujoco" => "Apache-2.0",
        "torch" | "nvidia-nccl-cu13" => "BSD-3-Clause",
        "nvidia-nvtx" => "Apache-2.0 WITH LLVM-exception",
        _ if name.starts_with("nvidia-") => "LicenseRef-NVIDIA-Proprietary",
        _ => bail!("nobody noted the licence of {name}: look into its wheel, and note it here"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_image_has_its_libraries_and_every_component_is_known_by_a_name_of_its_own() {
        let names = IMAGES.map(|image| {
            let document = document(&image).unwrap();
            let list = |field: &str| document[field].as_array().unwrap().clone();
            let references: Vec<Value> =
                list("components").iter().map(|part| part["bom-ref"].clone()).collect();
            let distinct: BTreeSet<String> = references.iter().map(Value::to_string).collect();
            assert_eq!(distinct.len(), references.len());
            for dependency in list("dependencies").iter().flat_map(|one| one["dependsOn"].as_array().unwrap())
            {
                assert!(references.contains(dependency), "{dependency}");
            }
            let required = |part: &&Value| part["scope"] == "required";
            let name = |part: &Value| part["name"].as_str().unwrap().to_owned();
            list("components").iter().filter(required).map(name).collect::<BTreeSet<String>>()
        });
        let [slim, learner, cuda] = &names;
        for known in ["getup", "getup-replay", "tokio", "sled", "mujoco", "libc6"] {
            assert!(names.iter().all(|names| names.contains(known)), "{known}");
        }
        for built_with in ["serde_derive", "protox"] {
            assert!(!learner.contains(built_with), "{built_with}");
        }
        assert!(!slim.contains("tch") && !slim.contains("torch"));
        assert!(learner.contains("tch") && learner.contains("torch") && !learner.contains("nvidia-cublas"));
        assert!(cuda.contains("nvidia-cublas"));
    }

    #[test]
    fn a_tree_is_read_with_what_depends_on_what() {
        let tree = Tree::parse(
            "0|a v1.0.0 (/here/a)|MIT||\n1|b v2.0.0+c-3|MIT/Apache-2.0|r|\n2|c v3.0.0 (proc-macro)|MIT|r|\n\
             1|c v3.0.0 (proc-macro)|MIT|r| (*)\n",
        );
        let tree = tree.unwrap();
        let [a, b, c] = [("a", "1.0.0"), ("b", "2.0.0+c-3"), ("c", "3.0.0")]
            .map(|(name, version)| (name.to_owned(), version.to_owned()));
        assert_eq!(tree.packages.keys().collect::<Vec<_>>(), [&a, &b, &c]);
        assert!(tree.packages[&a].is_own && !tree.packages[&c].is_own);
        assert_eq!(tree.packages[&b].license, "MIT OR Apache-2.0");
        assert_eq!(tree.dependencies[&a], BTreeSet::from([b.clone(), c.clone()]));
        assert_eq!(tree.dependencies[&b], BTreeSet::from([c]));
        assert_eq!(reference(&b), "pkg:cargo/b@2.0.0%2Bc-3");
        assert!(Tree::parse("0|a v1.0.0|||\n").is_err());
    }
}
