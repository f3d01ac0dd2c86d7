// Resolves with an image once it is there.

export function load(url) {
  return new Promise((resolve, reject) => {
    const image = new Image();
    image.addEventListener("load", () => resolve(image));
    image.addEventListener("error", () => reject(new Error("a slice could not be read")));
    image.src = url;
  });
}
