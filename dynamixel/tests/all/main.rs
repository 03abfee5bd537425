//! Integration tests of the servo bus in one binary; tests with their own allocator are separate binaries.

mod corpus;
mod live;
mod protocol;
