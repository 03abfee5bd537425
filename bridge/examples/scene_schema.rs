//! Prints the JSON schema of a scene of one axis, which a test compares with the tables of Python.

fn main() {
    println!("{}", haptether_bridge::scene::scene_schema());
}
