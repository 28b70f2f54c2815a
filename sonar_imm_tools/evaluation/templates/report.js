// Plots are unpacked and drawn when they come into view, plotly.js before the first of them.
const PLOTLYJS = 'plotly.packed.js';
const CONFIG = {displaylogo: false, responsive: true,
  modeBarButtonsToRemove: ['lasso2d', 'select2d', 'autoScale2d']};
function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'));
  return new Response(stream).text();
}
let ready = null;
function plotly() {
  ready = ready || packedPlotly().then(unpacked).then((text) => {
    const script = document.createElement('script');
    script.textContent = text;
    document.head.append(script);
  });
  return ready;
}
function packedPlotly() {
  const inside = document.getElementById('plotlyjs');
  if (inside !== null) return Promise.resolve(inside.textContent);
  return new Promise((good, bad) => {
    const script = document.createElement('script');
    script.onload = () => good(packedPlotlyJs);
    script.onerror = () => bad(new Error(`${PLOTLYJS} is not in the folder of this page`));
    script.src = PLOTLYJS;
    document.head.append(script);
  });
}
async function draw(plot) {
  if (plot.dataset.figure === undefined) return;
  const packed = plot.dataset.figure;
  delete plot.dataset.figure;
  try {
    if (!('DecompressionStream' in window)) {
      throw new Error('it takes a browser of 2023 or newer');
    }
    const [text] = await Promise.all([unpacked(packed), plotly()]);
    const figure = JSON.parse(text);
    const small = matchMedia('(max-width: 640px)').matches;  // there a finger scrolls the page
    if (small) {
      const {font, margin} = figure.layout;
      Object.assign(figure.layout,
        {dragmode: false, font: {...font, size: 11}, margin: {...margin, l: 46, r: 8}});
    }
    await Plotly.newPlot(plot, figure.data, figure.layout, {...CONFIG, displayModeBar: small ? false : 'hover'});
  } catch (error) {
    plot.textContent = `No plot: ${error.message}.`;
    plot.style.height = 'auto';
  }
}
const plots = [...document.querySelectorAll('.plot')];
const seen = new IntersectionObserver((entries) => {
  for (const entry of entries) if (entry.isIntersecting) draw(entry.target);
}, {rootMargin: '300px'});
plots.forEach((plot) => seen.observe(plot));
addEventListener('beforeprint', () => plots.forEach(draw));
