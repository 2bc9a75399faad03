//! The program as its user meets it: results, resumption, and what it says to nonsense.

#![cfg(all(feature = "learner", feature = "render"))]

mod common;

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use common::{Process, fail, free_address, getup, succeed, wait_for};
use serde_json::Value;

/// `getup train` with the smoke preset in a folder of its own.
fn train(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = getup(&["train", "--preset", "smoke"]);
    command.args(["--set", &format!("network.learner_metrics={}", free_address())]);
    command.args(arguments).current_dir(folder);
    command
}

fn evaluations(run: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(run.join("evaluations.jsonl")).unwrap_or_default();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn a_run_is_interrupted_resumed_and_ended_by_its_steps() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    let mut first = Process::start("first", folder.path(), &mut train(folder.path(), &["--run", "run"]));
    wait_for("two evaluations", Duration::from_secs(60), || (evaluations(&run).len() >= 2).then_some(()));
    first.signal("INT");
    assert!(first.wait(Duration::from_secs(10)).success(), "{}", first.log());

    let again = fail(&mut train(folder.path(), &["--run", "run"]));
    assert!(again.contains("--resume --run run"), "{again}");
    let mut resume = getup(&["train", "--run", "run", "--resume", "--preset", "laptop"]);
    let other = fail(resume.current_dir(folder.path()));
    assert!(other.contains("has preset smoke, not laptop"), "{other}");

    // A count of starts that was lost costs nothing of what is simulated next.
    std::fs::remove_file(run.join("incarnation")).unwrap();
    let before = evaluations(&run).last().unwrap()["env_steps"].as_u64().unwrap();
    let steps = (before + 2_000).to_string();
    let mut resume = getup(&["train", "--run", "run", "--resume", "--steps", &steps]);
    let said = succeed(resume.current_dir(folder.path()));
    assert!(said.contains("Done:") && said.contains("evaluate"), "{said}");
    let after = evaluations(&run).last().unwrap()["env_steps"].as_u64().unwrap();
    assert!(after >= before + 2_000, "{after} env steps");
    let model = run.join("models/last.safetensors");
    let report = succeed(&mut getup(&[
        "evaluate",
        model.to_str().unwrap(),
        "--episodes",
        "3",
        "--json",
        "--seed",
        "5",
    ]));
    let report: Value = serde_json::from_str(&report).unwrap();
    for key in ["rise_rate", "stand_rate", "mean_return", "min_return", "beta", "episodes", "seed"] {
        assert!(report[key].is_number(), "{key} in {report}");
    }
    for (arguments, expected) in
        [(["--set", "sac.hidden=[8, 8]"], "run's own configuration"), (["--seed", "7"], "has seed 0, not 7")]
    {
        let mut refused = getup(&["train", "--run", "run", "--resume"]);
        let error = fail(refused.args(arguments).current_dir(folder.path()));
        assert!(error.contains(expected), "{error}");
    }
    // Also where the seed comes from the environment, and for the learner's process.
    for role in [["train", "--resume"], ["learner", "--preset=smoke"]] {
        let mut refused = getup(&[role[0], role[1], "--run", "run"]);
        let error = fail(refused.env("GETUP_SEED", "7").current_dir(folder.path()));
        assert!(error.contains("has seed 0, not 7"), "{error}");
    }
    let mut elsewhere = getup(&["train", "--resume", "--set", "seed=4"]);
    let error = fail(elsewhere.env("GETUP_PRESET", "smoke").current_dir(folder.path()));
    assert!(error.contains("no run in runs/smoke-4"), "{error}");
    // What was refused changed nothing. Past its steps already: it saves and ends.
    let mut resume = getup(&["train", "--run", "run", "--resume", "--steps", "10"]);
    assert!(succeed(resume.current_dir(folder.path())).contains("Done:"));
}

#[test]
fn a_run_goes_on_without_its_replay_and_another_begins_with_its_networks() {
    let folder = tempfile::tempdir().unwrap();
    succeed(&mut train(folder.path(), &["--run", "first", "--steps", "2000"]));
    let first = folder.path().join("first");
    let last = evaluations(&first).pop().unwrap();
    let (env_steps, updates) = (last["env_steps"].as_u64().unwrap(), last["updates"].as_u64().unwrap());

    // What is carried to another machine: everything but the replay.
    let carried = folder.path().join("carried");
    succeed(Command::new("cp").args(["-r", "first", "carried"]).current_dir(folder.path()));
    std::fs::remove_dir_all(carried.join("replay")).unwrap();
    let resume = ["train", "--resume", "--run", "carried", "--steps", &(env_steps + 1_000).to_string()];
    let refill = ["--set", "network.learner_metrics=127.0.0.1:0", "--set", "sac.refill_steps=800"];
    succeed(getup(&resume).args(refill).current_dir(folder.path()));
    let after = evaluations(&carried).pop().unwrap();
    assert!(after["env_steps"].as_u64().unwrap() >= env_steps + 1_000, "{after}");
    // The ring is filled before updates go on: at 0.1 updates an env step and 800 env steps for the ring, the
    // other fifth of them, and what the actor made beyond.
    let made = after["updates"].as_u64().unwrap() - updates;
    assert!((1..=60).contains(&made), "{made} updates");

    let checkpoints = std::fs::read_dir(first.join("checkpoints")).unwrap();
    let checkpoint = checkpoints.map(|entry| entry.unwrap().path()).max().unwrap();
    let polish = ["curriculum.fixed=true", "curriculum.patience=1000", "evaluation.every=500"];
    let mut command = train(folder.path(), &["--run", "second", "--from", checkpoint.to_str().unwrap()]);
    polish.iter().for_each(|setting| _ = command.args(["--set", setting]));
    let said = succeed(&mut command);
    assert!(said.contains("no evaluation was better"), "{said}");
    let second = evaluations(&folder.path().join("second"));
    assert_eq!(second[0]["env_steps"], 0);
    assert_eq!(
        second[0]["mean"],
        evaluations(&first).pop().unwrap()["mean"],
        "the same actor on the same falls"
    );
    assert!(second.iter().all(|line| line["stage"] == 0 && line["beta"] == 1.0), "{second:?}");
    // A model is an actor too; its critics are not there.
    let model = ["--run", "of-a-model", "--from", "first/models/last.safetensors", "--steps", "1"];
    let mut command = train(folder.path(), &model);
    polish.iter().for_each(|setting| _ = command.args(["--set", setting]));
    succeed(command.args(["--set", "sac.critics_first=1000000"]));
    let of_a_model = evaluations(&folder.path().join("of-a-model"));
    assert!(of_a_model.last().unwrap()["updates"].as_u64().unwrap() > 0, "{of_a_model:?}");
    assert!(of_a_model.iter().all(|line| line["mean"] == second[0]["mean"]), "critics alone: {of_a_model:?}");

    for (file, expected) in [
        (checkpoint.to_str().unwrap(), "the configured networks have"),
        ("first/models/last.safetensors", "hidden layers of [8, 8]: take another model, or set [sac]"),
        ("first/config.toml", "the checkpoint first/config.toml is not usable"),
    ] {
        let from = ["--run", "third", "--from", file];
        let refused = fail(train(folder.path(), &from).args(["--set", "sac.hidden=[8, 8]"]));
        assert!(refused.contains(expected), "{refused}");
    }
}

#[test]
fn models_of_one_ancestor_are_averaged_into_one_that_is_evaluated() {
    let folder = tempfile::tempdir().unwrap();
    succeed(&mut train(folder.path(), &["--run", "a", "--steps", "600"]));
    for (run, seed) in [("b", "1"), ("c", "2")] {
        let from = ["--run", run, "--seed", seed, "--from", "a/models/last.safetensors", "--steps", "1"];
        succeed(train(folder.path(), &from).args(["--set", "curriculum.fixed=true"]));
    }
    let average = |models: &[&str], output: &str| {
        let mut command = getup(&["average"]);
        command.args(models).args(["--output", output]).current_dir(folder.path());
        command
    };
    let [b, c] = ["b/models/last.safetensors", "c/models/last.safetensors"];
    let said = succeed(&mut average(&[b, c], "mean.safetensors"));
    assert!(said.contains("The mean of 2 models is in mean.safetensors"), "{said}");
    let evaluate = ["evaluate", "mean.safetensors", "--episodes", "2", "--json"];
    let report: Value = serde_json::from_str(&succeed(getup(&evaluate).current_dir(folder.path()))).unwrap();
    assert_eq!(report["beta"], 1.0);

    let wider = ["--run", "wider", "--steps", "600", "--set", "sac.hidden=[8, 8]"];
    succeed(&mut train(folder.path(), &wider));
    // Models of before did not say their physics rate, which was 200.
    let mut old = getup_policy::Policy::load(folder.path().join(b)).unwrap();
    assert_eq!(old.metadata.remove("physics_hz").as_deref(), Some("200"));
    std::fs::write(folder.path().join("old.safetensors"), old.to_bytes()).unwrap();
    succeed(&mut average(&["old.safetensors", c], "old-and-new.safetensors"));
    let weaker = ["--run", "weaker", "--from", "a/models/last.safetensors", "--steps", "1"];
    let fixed = ["--set", "curriculum.fixed=true", "--set", "curriculum.beta_start=0.5"];
    succeed(train(folder.path(), &weaker).args(fixed));
    for (models, output, expected) in [
        (
            vec![b, "weaker/models/last.safetensors"],
            "m.safetensors",
            "weaker/models/last.safetensors: its beta is 0.5, and that of",
        ),
        (
            vec![b, "wider/models/last.safetensors"],
            "m.safetensors",
            "wider/models/last.safetensors: policy 1 has another shape",
        ),
        (vec![b, "nowhere.safetensors"], "m.safetensors", "nowhere.safetensors"),
        (vec![b, c], b, "is one of the models"),
        (vec![b], "m.safetensors", "2 values required"),
    ] {
        let error = fail(&mut average(&models, output));
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn a_strip_of_frames_is_a_picture_of_the_size_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    succeed(&mut train(folder.path(), &["--run", "run", "--steps", "600"]));
    let render =
        ["render", "run/models/last.safetensors", "--frames", "3", "--height", "64", "--seconds", "1"];
    let output = common::output(getup(&render).current_dir(folder.path()));
    let stderr = String::from_utf8_lossy(&output.stderr);
    if stderr.contains("cannot draw offscreen") {
        return common::skip(stderr);
    }
    assert!(output.status.success(), "{stderr}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("seconds 0.00, 0.50, 1.00 of fall 0"));
    let picture = std::fs::File::open(folder.path().join("strip.png")).unwrap();
    let mut reader = png::Decoder::new(std::io::BufReader::new(picture)).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    assert_eq!((info.width, info.height), (3 * 48, 64));
    // Sky, floor and a character.
    let colours: std::collections::BTreeSet<&[u8]> = pixels.chunks_exact(3).collect();
    assert!(colours.len() > 100, "{} colours", colours.len());
}

#[test]
fn deterministic_runs_of_one_seed_are_equal_byte_for_byte_and_those_of_another_are_not() {
    let folder = tempfile::tempdir().unwrap();
    let lines = |run: &str, seed: &str| {
        succeed(&mut train(
            folder.path(),
            &["--deterministic", "--steps", "2500", "--run", run, "--seed", seed],
        ));
        std::fs::read(folder.path().join(run).join("evaluations.jsonl")).unwrap()
    };
    let first = lines("a", "3");
    assert!(first.iter().filter(|byte| **byte == b'\n').count() >= 3);
    assert_eq!(first, lines("b", "3"));
    assert_ne!(first, lines("c", "4"));
}

#[test]
fn with_libtorch_held_to_avx2_training_goes_on_in_both_precisions() {
    let folder = tempfile::tempdir().unwrap();
    for precision in ["fp32", "bf16"] {
        let setting = format!("sac.precision={precision}");
        let mut command = train(folder.path(), &["--steps", "1000", "--run", precision, "--set", &setting]);
        // ATen's own kernels, oneDNN and MKL each choose their instructions.
        command.env("ATEN_CPU_CAPABILITY", "default");
        command.env("ONEDNN_MAX_CPU_ISA", "AVX2").env("MKL_ENABLE_INSTRUCTIONS", "AVX2");
        succeed(&mut command);
        assert!(folder.path().join(precision).join("models/last.safetensors").exists());
    }
}

#[test]
fn recorded_episodes_are_replayed_to_the_same_numbers() {
    let folder = tempfile::tempdir().unwrap();
    let golden = concat!(env!("CARGO_MANIFEST_DIR"), "/sim/tests/golden/getup_cast.json");
    let output = folder.path().join("out.json");
    succeed(&mut getup(&["rollout", "--input", golden, "--output", output.to_str().unwrap()]));
    let read =
        |path: &Path| -> Value { serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap() };
    let (ours, theirs) = (read(&output), read(Path::new(golden)));
    for key in ["rewards", "observations", "terms", "qpos"] {
        assert_close(&ours["rollouts"][0][key], &theirs["rollouts"][0][key], key);
    }
    let missing = fail(&mut getup(&["rollout", "--input", "nowhere.json", "--output", "x.json"]));
    assert!(missing.contains("cannot read nowhere.json"), "{missing}");
}

fn assert_close(ours: &Value, theirs: &Value, path: &str) {
    match (ours, theirs) {
        (Value::Array(ours), Value::Array(theirs)) => {
            assert_eq!(ours.len(), theirs.len(), "{path}");
            for (index, (ours, theirs)) in ours.iter().zip(theirs).enumerate() {
                assert_close(ours, theirs, &format!("{path}[{index}]"));
            }
        }
        _ => assert!((ours.as_f64().unwrap() - theirs.as_f64().unwrap()).abs() < 1e-9, "{path}"),
    }
}

#[test]
fn falls_are_written_and_repeat_by_their_seed() {
    let folder = tempfile::tempdir().unwrap();
    let draw = |name: &str| {
        let path = folder.path().join(name);
        succeed(&mut getup(&["falls", "--count", "6", "--seed", "9", "--output", path.to_str().unwrap()]));
        std::fs::read(path).unwrap()
    };
    assert_eq!(draw("a.json"), draw("b.json"));
    let falls: Value = serde_json::from_slice(&draw("a.json")).unwrap();
    assert_eq!(falls["falls"].as_array().unwrap().len(), 6);
}

#[test]
fn nonsense_is_answered_with_the_thing_the_value_and_the_way_out() {
    let folder = tempfile::tempdir().unwrap();
    let said = |arguments: &[&str]| fail(train(folder.path(), arguments).env("RUST_BACKTRACE", "0"));
    for (arguments, expected) in [
        (&["--set", "sac.bach=3"][..], "unknown setting sac.bach; did you mean sac.batch?"),
        (&["--set", "sac.gamma=1.5"], "sac.gamma = 1.5: at least 0 and under 1"),
        (&["--set", "curriculum.n_min=9", "--set", "curriculum.n_max=3"], "at most curriculum.n_max"),
        (&["--resume", "--run", "nowhere"], "there is no run in nowhere"),
        (&["--from", "nowhere.safetensors"], "cannot read the checkpoint nowhere.safetensors"),
        (&["--set", "actor.fall_pool=100001"], "actor.fall_pool is 100001: it must be at most 100000"),
        (&["--config", "nowhere.toml"], "cannot read the configuration nowhere.toml"),
        (&["--set", "preset=paper"], "choose it with --preset paper"),
        (&["--set", "sac.uniform_steps=2000000"], "sac.uniform_steps = 2000000: at most replay.capacity"),
    ] {
        let stderr = said(arguments);
        assert!(stderr.contains(expected), "{arguments:?} said:\n{stderr}");
    }
    let error = fail(&mut getup(&["evaluate", "Cargo.toml"]));
    assert!(error.contains("Cargo.toml: not a getup model"), "{error}");
    use std::os::unix::ffi::OsStrExt;
    let odd = std::ffi::OsStr::from_bytes(b"\xff");
    succeed(
        getup(&["doctor", "--preset", "smoke", "--set", "network.replay=127.0.0.1:0"])
            .args(["--set", "network.learner=127.0.0.1:0", "--set", "network.replay_metrics=127.0.0.1:0"])
            .args(["--set", "network.learner_metrics=127.0.0.1:0"])
            .env("ODD", odd),
    );
    let error = fail(getup(&["status"]).env("GETUP_RUN", odd));
    assert!(error.contains("GETUP_RUN"), "{error}");
    let error = fail(&mut getup(&["evaluate", "nowhere.safetensors"]));
    assert!(error.contains("nowhere.safetensors"), "{error}");
    assert!(folder.path().read_dir().unwrap().next().is_none(), "a refused command leaves nothing behind");
}

#[test]
fn the_doctor_names_every_check_and_finds_a_taken_port() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("network.replay={}", taken.local_addr().unwrap());
    let mut command = getup(&["doctor", "--preset", "smoke", "--json", "--set", &address]);
    for name in ["learner", "replay_metrics", "learner_metrics"] {
        command.args(["--set", &format!("network.{name}={}", free_address())]);
    }
    let output = common::output(&mut command);
    assert!(!output.status.success());
    let checks: Vec<Value> = serde_json::from_slice(&output.stdout).unwrap();
    for check in &checks {
        // Whether there is room is the machine's.
        if check["name"] != "disk" && check["name"] != "memory" {
            assert_eq!(check["good"], check["name"] != "ports", "{check}");
        }
    }
    assert!(checks.len() >= 7, "{checks:?}");
}

/// A plan of one fault, against what answers as a cluster that gets on with its work.
fn plan(folder: &Path, fault: &str) -> Command {
    let observe = r#"
n=$(( $(cat n 2>/dev/null || echo 0) + 1 )); echo $n >n
echo "{\"replay\": {\"store\": \"a\", \"transitions\": $n, \"env_steps\": $n}, \"learner\": {\"version\": \"1.$n\",
    \"updates\": $n, \"stage\": 0, \"state\": \"training\", \"actors\": [{\"silent_seconds\": 0.1}]}}"
"#;
    let text = format!("observe = '''{observe}'''\n[[fault]]\nname = \"it breaks\"\n{fault}");
    std::fs::write(folder.join("plan.toml"), text).unwrap();
    let mut command = getup(&["chaos", "--plan", "plan.toml", "--yes"]);
    command.current_dir(folder);
    command
}

#[test]
fn a_fault_is_healed_after_half_an_injection_and_after_an_interruption() {
    let folder = tempfile::tempdir().unwrap();
    let broken = folder.path().join("broken");
    let half = "inject = 'touch broken; false'\nheal = 'rm was-not-there; rm broken'";
    let said = fail(&mut plan(folder.path(), half));
    assert!(said.contains("did not come through 1"), "{said}");
    assert!(!broken.exists());

    let held = "inject = 'touch broken'\nheal = 'rm broken'\nhold = 600";
    let mut chaos = Process::start("chaos", folder.path(), &mut plan(folder.path(), held));
    wait_for("the fault", Duration::from_secs(20), || broken.exists().then_some(()));
    chaos.signal("INT");
    assert!(!chaos.wait(Duration::from_secs(20)).success());
    assert!(!broken.exists(), "{}", chaos.log());

    let refused = fail(&mut plan(folder.path(), "inject = 'true'\nhold = -1.0"));
    assert!(refused.contains("hold = -1"), "{refused}");
}

#[test]
fn what_cannot_be_written_or_played_is_refused_before_the_work() {
    let folder = tempfile::tempdir().unwrap();
    let strong = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/strong.safetensors");
    for name in ["a", "b"] {
        std::fs::copy(&strong, folder.path().join(name)).unwrap();
    }
    std::fs::create_dir_all(folder.path().join("run/models")).unwrap();
    std::fs::copy(&strong, folder.path().join("run/models/best.safetensors")).unwrap();
    for (arguments, expected) in [
        (&["average", "a", "b", "--output", "./a"][..], "./a is one of the models"),
        (&["average", "a", "b", "--output", "no/c"], "no/c: there is no folder no"),
        (&["evaluate", "a", "--record", "no/c"], "no/c: there is no folder no"),
        (&["evaluate", "a", "--beta", "1e300"], "over 0 and at most 4"),
        (&["evaluate", "a", "--beta", "-1"], "--beta -1: over 0"),
        (&["evaluate", "a", "--seed", "4294967296"], "4294967296"),
        (&["evaluate", "run"], "run is a folder: name a file in it, such as run/models/best.safetensors"),
        (&["falls", "--output", "f", "--count", "18446744073709551615"], "from 1 to 1000000"),
        (&["falls", "--output", "f", "--count", "0"], "from 1 to 1000000"),
        (&["rollout", "--input", "a", "--output", "./a"], "./a is the input"),
        (&["settings", "--set", "network.replay=nope"], "network.replay = \"nope\": HOST:PORT"),
        (&["settings", "--set", "network.learner=h:99999"], "network.learner = \"h:99999\": HOST:PORT"),
        (&["settings", "--set", "run=../up"], "a name without a `/`"),
        (&["settings", "--set", "sac.batch=0"], "sac.batch = 0"),
        (&["settings", "--set", "replay.priority_exponent=-1"], "replay.priority_exponent = -1"),
        (&["train", "--run", "r", "--from", "run"], "--from run: is a folder"),
        (
            &["train", "--run", "r", "--from", "a", "--set", "task.character=cast"],
            "68 numbers in, 21 motors, SimBa of width 128",
        ),
    ] {
        let error = fail(getup(arguments).current_dir(folder.path()));
        assert!(error.contains(expected) && !error.contains("panicked"), "{arguments:?} said:\n{error}");
    }
    assert_eq!(
        std::fs::read_dir(folder.path()).unwrap().count(),
        3,
        "a refused command leaves nothing behind"
    );
}

#[test]
fn a_command_that_prints_ends_with_its_reader() {
    let mut command = getup(&["settings"]);
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_eq!(String::from_utf8_lossy(&output.stderr), "");
}

/// Words of these letters in a text.
fn words<'a>(text: &'a str, letters: impl Fn(char) -> bool + 'a) -> impl Iterator<Item = &'a str> + 'a {
    text.split(move |letter| !letters(letter)).filter(|word| !word.is_empty())
}

#[test]
fn every_setting_and_metric_that_a_document_names_exists() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let settings: toml::Table = succeed(&mut getup(&["settings"])).parse().unwrap();
    let metrics = std::fs::read_to_string(root.join("docs/metrics.md")).unwrap();
    let mut documents = vec![root.join("README.md"), root.join("SECURITY.md"), root.join("models/README.md")];
    documents.extend(std::fs::read_dir(root.join("docs")).unwrap().map(|entry| entry.unwrap().path()));
    documents.retain(|path| path.extension().is_some_and(|extension| extension == "md"));
    let (mut named, mut unknown) = (0, Vec::new());
    for path in documents {
        let text = std::fs::read_to_string(&path).unwrap();
        for word in words(&text, |letter| letter.is_ascii_lowercase() || letter == '_') {
            if word.starts_with("getup_") && !metrics.contains(word) {
                unknown.push(format!("{}: {word}", path.display()));
            }
        }
        // In code, where what is no setting has no dot after a table's name.
        for code in
            text.split('`').skip(1).step_by(2).chain(text.lines().filter(|line| line.contains("--set ")))
        {
            for word in words(code, |letter| letter.is_ascii_lowercase() || "._/".contains(letter)) {
                let Some((table, key)) = word.split_once('.').filter(|(_, key)| !key.is_empty()) else {
                    continue;
                };
                let Some(table) = settings.get(table).and_then(toml::Value::as_table) else { continue };
                named += 1;
                if !table.contains_key(key.split('.').next().unwrap()) {
                    unknown.push(format!("{}: {word}", path.display()));
                }
            }
        }
    }
    assert!(named > 50 && unknown.is_empty(), "{named} settings are named, these do not exist: {unknown:#?}");
}
