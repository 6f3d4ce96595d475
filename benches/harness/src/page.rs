// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the pages of reports have in common.

use std::fmt::{self, Write};

use crate::verdict::{self, Verdict};

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;color:#222831;max-width:1120px;margin:2em auto;padding:0 1em}\
h1{font-size:26px;margin-bottom:.2em}h2{font-size:19px;margin:2em 0 .4em}p,li{max-width:68em}\
figure{margin:1em 0;overflow-x:auto}figcaption{color:#666e7a;font-size:14px;max-width:68em}\
svg{max-width:100%;height:auto}\
table{border-collapse:collapse;font-size:13px;font-variant-numeric:tabular-nums}\
th,td{padding:2px 9px;border-bottom:1px solid #e2e6eb;text-align:right;white-space:nowrap}\
th{background:#f4f6f8;position:sticky;top:0}.l{text-align:left}.w{white-space:normal}tr.first td{border-top:2px solid #c3cad3}\
.late{color:#cc2026;font-weight:600}.scroll{overflow:auto;max-height:36em}";

pub const END: &str = "</body></html>\n";

/// Begins one: what the window is called, the heading, and what is said below it, which may have marks.
pub fn begin(out: &mut String, title: &str, heading: &str, introduction: &str) -> fmt::Result {
    write!(
        out,
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>{title}</title>\
         <meta name=\"viewport\" content=\"width=device-width\"><style>{STYLE}</style></head><body>\n\
         <h1>{heading}</h1>\n<p>{introduction}</p>\n"
    )
}

/// What must hold, and whether it does.
pub fn verdicts(out: &mut String, heading: &str, verdicts: &[Verdict]) -> fmt::Result {
    writeln!(out, "<h2>{heading}</h2>")?;
    verdict::table(verdicts).html(out)
}

/// A picture and what it shows.
pub fn figure(out: &mut String, svg: &str, caption: &str) -> fmt::Result {
    let caption =
        if caption.is_empty() { String::new() } else { format!("<figcaption>{caption}</figcaption>") };
    writeln!(out, "<figure>\n{svg}\n{caption}</figure>")
}

/// A heading and a list of lines.
pub fn list(out: &mut String, title: &str, lines: &[String]) -> fmt::Result {
    writeln!(out, "<h2>{title}</h2>\n<ul>")?;
    for line in lines {
        writeln!(out, "<li>{}</li>", escape(line))?;
    }
    out.push_str("</ul>\n");
    Ok(())
}

pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}
