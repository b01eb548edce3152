// What looks wrong on a page, a line each: texts that overlap, are cut, or leave the screen.
const faults = [];
const width = document.documentElement.clientWidth;
if (document.documentElement.scrollWidth > width)
    faults.push(`the page is ${document.documentElement.scrollWidth} px wide, the screen ${width}`);
const scrolls = (e) => e.closest(".wide, pre");
const seen = (e) => e.checkVisibility({ opacityProperty: true, visibilityProperty: true }) && !e.closest(".skip, option, select, [role=img] svg title");
const texts = [];
const walker = document.createTreeWalker(document.querySelector("main").parentElement, NodeFilter.SHOW_TEXT);
for (let node; (node = walker.nextNode());) {
    const home = node.parentElement;
    if (!node.textContent.trim() || home.closest("script, style, svg") || !seen(home)) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    for (const box of range.getClientRects())
        if (box.width > 1 && box.height > 1) texts.push({ home, box, text: node.textContent.trim().slice(0, 40) });
}
for (const { home, box, text } of texts) {
    if (scrolls(home)) continue;
    if (box.right > width + 1 || box.left < -1) faults.push(`"${text}" leaves the screen: ${box.left.toFixed(0)} to ${box.right.toFixed(0)}`);
    for (let e = home; e; e = e.parentElement) {
        const style = getComputedStyle(e), cut = e.getBoundingClientRect();
        if (style.overflowX === "hidden" && (box.right > cut.right + 1 || box.left < cut.left - 1)) faults.push(`"${text}" is cut`);
        if (style.overflowY === "hidden" && (box.bottom > cut.bottom + 2)) faults.push(`"${text}" is cut below`);
    }
}
const fixed = (e) => { for (; e; e = e.parentElement) if (["sticky", "fixed"].includes(getComputedStyle(e).position)) return e; return null; };
for (let i = 0; i < texts.length; i += 1)
    for (let j = i + 1; j < texts.length; j += 1) {
        const [one, other] = [texts[i], texts[j]];
        if (scrolls(one.home) || scrolls(other.home) || fixed(one.home) !== fixed(other.home)) continue;
        const wide = Math.min(one.box.right, other.box.right) - Math.max(one.box.left, other.box.left);
        const high = Math.min(one.box.bottom, other.box.bottom) - Math.max(one.box.top, other.box.top);
        if (wide > 1.5 && high > 4) faults.push(`"${one.text}" and "${other.text}" overlap by ${wide.toFixed(0)}x${high.toFixed(0)} px`);
    }
for (const image of document.images) if (image.complete && !image.naturalWidth) faults.push(`${image.alt}: no picture`);
for (const plot of document.querySelectorAll(".plot"))
    if (!plot.querySelector("canvas") || plot.querySelector("canvas").getBoundingClientRect().right > width) faults.push(`${plot.id} is not drawn within the screen`);
return faults;
