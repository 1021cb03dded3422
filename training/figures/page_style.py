"""How a report looks: one column on a phone, light or dark as the reader has it, nothing from elsewhere."""

from __future__ import annotations

__all__ = ["STYLE"]

# Colours told apart by those who do not see red and green apart, too (Okabe and Ito 2008), lighter on dark.
STYLE = """
:root { color-scheme: light dark; --page: #ffffff; --ink: #1d2327; --soft: #5b6670; --rule: #dde2e6;
  --panel: #f5f7f8; --link: #00639c; --good: #007a58; --bad: #b84600;
  --c0: #0072b2; --c1: #d55e00; --c2: #009e73; --c3: #b5568f;
  --c4: #b98600; --c5: #3f9fd0; --c6: #444444; --c7: #8a6d3b }
@media (prefers-color-scheme: dark) { :root { --page: #14181b; --ink: #e4e9ec; --soft: #9aa7b0; --rule: #333c43;
  --panel: #1c2226; --link: #6cc0f0; --good: #3fc79a; --bad: #ff9a52;
  --c0: #5ab4f0; --c1: #ff8a3d; --c2: #35c99b; --c3: #e094c0;
  --c4: #f0b93a; --c5: #9bd5f5; --c6: #c8cdd1; --c7: #cdb182 } }
* { box-sizing: border-box }
body { margin: 0 auto; max-width: 84rem; padding: 1.2rem clamp(.8rem, 3vw, 2rem) 4rem; background: var(--page);
  color: var(--ink); font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif }
h1 { font-size: 1.7rem; line-height: 1.2; margin: .4rem 0 .3rem }
h2 { font-size: 1.35rem; margin: 2.8rem 0 .3rem; padding-top: .8rem; border-top: 2px solid var(--rule) }
h3 { font-size: 1.05rem; margin: 1.6rem 0 .5rem }
p { margin: .3rem 0 .7rem; max-width: 52rem } .soft { color: var(--soft) } a { color: var(--link) }
nav { display: flex; flex-wrap: wrap; gap: .3rem 1rem; margin: .8rem 0 }
.wide { overflow-x: auto; margin: 0 0 .6rem }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums }
th, td { padding: .35rem .5rem; text-align: right; border-bottom: 1px solid var(--rule); white-space: nowrap;
  vertical-align: top }
thead th { color: var(--soft); font-weight: 600; vertical-align: bottom; white-space: normal; min-width: 4.6rem }
th:first-child { text-align: left; position: sticky; left: 0; background: var(--page) }
tbody th { font-weight: 600; max-width: 24rem; overflow: hidden; text-overflow: ellipsis }
h1, h2, h3, p, nav, summary, figcaption { overflow-wrap: anywhere }
td.words { text-align: left; white-space: normal }
td small { display: block; color: var(--soft); font-size: .78rem }
.better { color: var(--good); font-weight: 600 } .worse { color: var(--bad); font-weight: 600 }
.best { font-weight: 700 }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 24rem), 1fr)); gap: 1rem }
svg { width: 100%; height: auto; background: var(--panel); border-radius: 6px }
svg text { fill: var(--soft); font-size: 13px } .grid { stroke: var(--rule) } .goal { stroke-dasharray: 4 4 }
.line { fill: none; stroke: var(--c); stroke-width: 2.2 } .dashed { stroke-dasharray: 7 4 }
.ideal { stroke-width: 1; opacity: .6 } .thin { stroke-width: 1.2 } .dot { fill: var(--c) }
.band { fill: var(--c); fill-opacity: .13 }
.key { display: inline-block; width: 1.1rem; border-top: 3px solid var(--c); vertical-align: middle;
  margin-right: .4rem } .key.dashed { border-top-style: dashed }
.cases { display: grid; grid-template-columns: repeat(auto-fill, minmax(9.5rem, 1fr)); gap: .8rem;
  margin: .4rem 0 }
figure { margin: 0; font-size: .8rem; line-height: 1.35 }
figure img { display: block; width: 100%; height: 150px; object-fit: contain; background: #e9ebec;
  border-radius: 6px }
@media (max-width: 40rem) { th:first-child { white-space: normal; max-width: 8rem } }
figcaption { margin-top: .3rem; color: var(--soft) } figcaption b { color: var(--ink) }
details { margin: .6rem 0 } summary { cursor: pointer; font-weight: 600 }
pre { overflow-x: auto; background: var(--panel); padding: .8rem; border-radius: 6px; font-size: .8rem }
""" + "".join(f".c{k} {{ --c: var(--c{k}) }}\n" for k in range(8))
