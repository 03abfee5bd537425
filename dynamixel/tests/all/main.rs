//! The integration tests of the servo bus, one binary; those with an allocator of their own are binaries apart.

mod corpus;
mod live;
mod protocol;
