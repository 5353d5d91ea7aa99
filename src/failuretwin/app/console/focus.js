/* Keeps the focus, where it is seen, of a part that is drawn anew and of a page loaded again. */
{
const all = () => [...document.querySelectorAll(
  '.page :is(a[href], button, input, select, [tabindex="0"]), header select')];
const words = (one) =>
  one.tagName + (one.getAttribute('aria-label') || one.name || one.textContent);
let last = null, said = sessionStorage.focus, place = 0;
sessionStorage.removeItem('focus');
addEventListener('focusin', (e) => {
  if (!e.target.matches(':focus-visible, .kept')) return;
  last = e.target; said = words(last); place = all().indexOf(last); });
addEventListener('focusout', (e) => setTimeout(() => {
  if (last === e.target && last.isConnected) last = said = null; }));
addEventListener('beforeunload', () => { if (last) sessionStorage.focus = words(last); });
new MutationObserver(() => {
  if (!said || last?.isConnected || document.activeElement !== document.body) return;
  const found = all(), same = found.find((one) => words(one) === said);
  const next = same || (last && found[Math.min(place, found.length - 1)]);
  if (!next) return;
  next.classList.add('kept');
  next.addEventListener('blur', () => next.classList.remove('kept'), {once: true});
  next.focus({preventScroll: true});
}).observe(document, {childList: true, subtree: true});
}
