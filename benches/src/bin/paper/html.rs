use crate::{Result, report::Report};
pub fn page(_: &Report) -> Result<String> {
    Ok(String::new())
}
