//! Compiles the shim to a matrix product of libtorch that tch does not expose.

fn main() {
    println!("cargo::rerun-if-changed=src/cpu/brgemm.cc");
    println!("cargo::rerun-if-env-changed=LIBTORCH");
    #[cfg(feature = "torch")]
    compile();
}

#[cfg(feature = "torch")]
fn compile() {
    let Some(libtorch) = std::env::var_os("LIBTORCH") else {
        panic!("LIBTORCH is not set: `cargo xtask setup` installs libtorch and notes its place");
    };
    cc::Build::new()
        .cpp(true)
        .std("c++17")
        .define("_GLIBCXX_USE_CXX11_ABI", "1")
        .warnings(false)
        .include(std::path::PathBuf::from(libtorch).join("include"))
        .file("src/cpu/brgemm.cc")
        .compile("getup_brgemm");
}
