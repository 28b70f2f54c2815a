// Plots are unpacked and drawn when they come into view, plotly.js before the first of them.
const PLOTLYJS = 'plotly.packed.js';
const CONFIG = {displaylogo: false, responsive: true,
  modeBarButtonsToRemove: ['lasso2d', 'select2d', 'autoScale2d']};
async function unpacked(text) {
  const {body} = await fetch(`data:;base64,${text}`);
  return new Response(body.pipeThrough(new DecompressionStream('gzip')));
}
function scriptOf(src, why) {
  return new Promise((good, bad) => {
    const script = document.createElement('script');
    script.onload = good;
    script.onerror = () => bad(new Error(why));
    script.src = src;
    document.head.append(script);
  });
}
let ready = null;
function plotly() {
  ready = ready || packedPlotly().then(unpacked).then((response) => response.blob())
    .then((blob) => scriptOf(URL.createObjectURL(blob), 'plotly.js does not start'));
  return ready;
}
async function packedPlotly() {
  const inside = document.getElementById('plotlyjs');
  if (inside !== null) return inside.textContent;
  await scriptOf(PLOTLYJS, `${PLOTLYJS} is not in the folder of this page`);
  return packedPlotlyJs;
}
async function draw(plot) {
  if (plot.dataset.figure === undefined) return;
  const packed = plot.dataset.figure;
  delete plot.dataset.figure;
  try {
    if (!('DecompressionStream' in window)) {
      throw new Error('it takes a browser of 2023 or newer');
    }
    const [response] = await Promise.all([unpacked(packed), plotly()]);
    const figure = await response.json();
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
