// What tests ask a page about itself.
({
  // Whether all of an element is on the screen, with nothing before it, and large enough for a thumb.
  isUncovered(selector) {
    const element = document.querySelector(selector);
    const box = element.getBoundingClientRect();
    const isInside = box.left >= 0 && box.top >= 0 && box.right <= innerWidth && box.bottom <= innerHeight;
    const places = [
      [box.left + 8, box.top + 8], [box.right - 8, box.top + 8],
      [box.left + 8, box.bottom - 8], [box.right - 8, box.bottom - 8],
      [box.left + box.width / 2, box.top + box.height / 2],
    ];
    return isInside && box.width >= 88 && box.height >= 44
      && places.every(([x, y]) => element.contains(document.elementFromPoint(x, y)));
  },

  // Contrast of every visible text with its ground by WCAG 2.2, beside what it is.
  contrasts() {
    const colour = (text) => {
      const numbers = text.match(/[\d.]+/g).map(Number);
      return { rgb: numbers.slice(0, 3), alpha: numbers[3] ?? 1 };
    };
    const luminance = (rgb) => {
      const linear = rgb.map((value) => value / 255)
        .map((value) => (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4));
      return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2];
    };
    const ground = (element) => {
      for (let at = element; at; at = at.parentElement) {
        const { rgb, alpha } = colour(getComputedStyle(at).backgroundColor);
        if (alpha > 0.99) return rgb;
      }
      return [255, 255, 255];
    };
    const hasText = (element) => [...element.childNodes].some((node) => node.nodeType === 3 && node.data.trim());
    return [...document.querySelectorAll("body *")]
      .filter((element) => element.checkVisibility() && hasText(element) && !element.closest("svg, button:disabled"))
      .map((element) => {
        const pair = [luminance(colour(getComputedStyle(element).color).rgb), luminance(ground(element))];
        const ratio = (Math.max(...pair) + 0.05) / (Math.min(...pair) + 0.05);
        return [ratio, element.className || element.id || element.tagName, element.innerText.slice(0, 30)];
      });
  },

  // Frames that the dashboard draws in half a second, and how long these really were.
  frames() {
    const [from, start] = [eraHaptics.frames, performance.now()];
    return new Promise((done) => {
      setTimeout(() => done([eraHaptics.frames - from, (performance.now() - start) / 1000]), 500);
    });
  },

  // Colours [r, g, b] of the rings of fingers that feel something, and of the canvas there.
  fingersOn(selector) {
    const canvas = document.querySelector(selector);
    const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
    copy.drawImage(canvas, 0, 0);
    const box = canvas.getBoundingClientRect();
    return [...document.querySelectorAll(".contact.target")].map((ring) => {
      const { x, y, width, height } = ring.getBoundingClientRect();
      const column = ((x + width / 2 - box.x) / box.width) * canvas.width;
      const row = ((y + height / 2 - box.y) / box.height) * canvas.height;
      const { data } = copy.getImageData(Math.floor(column), Math.floor(row), 1, 1);
      return [getComputedStyle(ring).stroke.match(/\d+/g).map(Number), [...data.slice(0, 3)]];
    });
  },

  // How many colours a canvas shows.
  colours(selector) {
    const { width, height } = document.querySelector(selector);
    const copy = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
    copy.drawImage(document.querySelector(selector), 0, 0);
    const { data } = copy.getImageData(0, 0, width, height);
    return new Set(new Uint32Array(data.buffer)).size;
  },
})
