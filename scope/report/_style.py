"""How every page looks: light and dark as the reader's system is, wide and narrow, and on A4."""

STYLE = """
:root{color-scheme:light dark;--ink:#1c2430;--soft:#55606e;--faint:#5f6978;--page:#fff;--line:#d5dae1;--row:#e2e6eb;--head:#f4f6f8;
--good:#e8f5ec;--warn:#fff6e0;--bad:#fdeaea;--plain:#eef1f5;--grid:#e4e8ed;--link:#1f5fa8;
--c0:#1f5fa8;--c1:#c0342c;--c2:#1a7a42;--c3:#8a5bb5;--c4:#8f6200;--c5:#1f7a7a}
@media (prefers-color-scheme:dark){:root{--ink:#e3e8ee;--soft:#a7b1bd;--faint:#8a95a3;--page:#12171d;--line:#3a444f;--row:#2a323b;--head:#1c232b;
--good:#14321f;--warn:#3a2f10;--bad:#3f1a1a;--plain:#1d252e;--grid:#2c353f;--link:#7fb2ee;
--c0:#7fb2ee;--c1:#f0827a;--c2:#5fc98c;--c3:#c09be0;--c4:#e0ac3a;--c5:#62c9c9}}
*{box-sizing:border-box}html{scroll-behavior:smooth}
body{font:15px/1.5 system-ui,sans-serif;margin:0;color:var(--ink);background:var(--page)}
.page{max-width:100rem;margin:0 auto;padding:1.5rem 1rem 3rem;display:grid;grid-template-columns:minmax(0,1fr);gap:0 2.5rem}
main{min-width:0}.beside{margin:0 0 1rem}.beside a{margin-right:1.2rem}a{color:var(--link)}
h1{font-size:1.6rem;margin:0 0 .6rem;overflow-wrap:anywhere}
h2{font-size:1.15rem;margin:2rem 0 .5rem;border-bottom:1px solid var(--line);padding-bottom:.2rem;scroll-margin-top:1rem}
p{max-width:52rem;overflow-wrap:anywhere}
nav{font-size:.92rem;margin:0 0 1rem}nav ol{list-style:none;margin:0;padding:0;display:flex;flex-wrap:wrap;gap:.15rem 1rem}nav a{text-decoration:none}
@media (min-width:80rem){.page.long{grid-template-columns:14rem minmax(0,1fr)}.page.long nav{position:sticky;top:1.5rem;align-self:start;grid-row:1/3}
.page.long nav ol{display:block}.page.long nav li{margin:.3rem 0}.page.long main{grid-column:2}}
.verdict{padding:.7rem 1rem;border-left:6px solid;border-radius:3px;font-size:1.05rem;margin:0 0 1rem;max-width:none}
.good{background:var(--good);border-color:#1f8a4c}.warn{background:var(--warn);border-color:#c98a00}
.bad{background:var(--bad);border-color:#c0342c}.plain{background:var(--plain);border-color:#8793a3}
.wide{overflow-x:auto;margin:.5rem 0 1rem}
table{border-collapse:collapse;font-variant-numeric:tabular-nums}
th,td{padding:.25rem .7rem;border-bottom:1px solid var(--row);text-align:right;vertical-align:top}
th{background:var(--head);font-weight:600}td:first-child,th:first-child,td.text,th.text{text-align:left}
tr.off td{background:var(--bad)}tr.off td:first-child{box-shadow:inset 5px 0 #c0342c;font-weight:600}tr.off td:first-child::before{content:"\\25B6\\00A0"}
td.text{min-width:6rem;max-width:34rem;overflow-wrap:break-word}td:not(.text){white-space:nowrap}
.figures{display:flex;flex-wrap:wrap;gap:.9rem 1.1rem;margin:.7rem 0}
figure{margin:0;max-width:100%}figure img{max-width:100%;height:auto;border:1px solid var(--line);display:block}
figure.whole{flex:1 1 100%}figure svg{max-width:100%;height:auto;display:block}
figcaption{color:var(--soft);font-size:.88rem;max-width:40rem;margin-top:.2rem;overflow-wrap:anywhere}
scope-cloud{display:block}
@media screen and (prefers-color-scheme:dark){svg path[fill=none],svg text[style]{filter:brightness(1.7)}}
svg text{font:11px system-ui,sans-serif;fill:var(--ink)}svg .grid{stroke:var(--grid)}
path.c0{stroke:var(--c0)}svg text.c0{fill:var(--c0)}path.c1{stroke:var(--c1)}svg text.c1{fill:var(--c1)}path.c2{stroke:var(--c2)}svg text.c2{fill:var(--c2)}path.c3{stroke:var(--c3)}svg text.c3{fill:var(--c3)}path.c4{stroke:var(--c4)}svg text.c4{fill:var(--c4)}path.c5{stroke:var(--c5)}svg text.c5{fill:var(--c5)}
footer{margin-top:3rem;color:var(--faint);font-size:.85rem;border-top:1px solid var(--line);padding-top:.6rem}
footer dl{display:grid;grid-template-columns:max-content minmax(0,1fr);gap:.1rem 1rem;margin:0}footer dd{margin:0;overflow-wrap:anywhere}
@media print{@page{size:A4;margin:14mm}:root{color-scheme:light;--ink:#000;--soft:#333;--faint:#444;--page:#fff;--line:#bbb;--row:#ccc;--head:#eee;
--good:#fff;--warn:#fff;--bad:#fff;--plain:#fff;--grid:#ddd;--link:#000;
--c0:#1f5fa8;--c1:#c0342c;--c2:#1a7a42;--c3:#8a5bb5;--c4:#8f6200;--c5:#1f7a7a}
body{font-size:10pt}.page,.page.long{display:block;padding:0}nav{display:none}.wide{overflow:visible}
table,figure,.verdict{break-inside:avoid}tr{break-inside:avoid}thead{display:table-header-group}h2{break-after:avoid}td.text{max-width:none}
figure:not(.whole){width:47%!important}figure img{max-height:90mm}}
"""
