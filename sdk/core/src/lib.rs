//! PSAO core.
#![no_std]
