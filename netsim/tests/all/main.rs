//! The integration tests of netsim, one binary.

mod corpus;
