// Khronos' validator on files: prints errors, and fails if there are any.
const fs = require("fs");
const validator = require("gltf-validator");

async function validate(path) {
    const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(path)));
    for (const issue of report.issues.messages.filter((message) => message.severity === 0)) {
        console.error(`${path}: ${issue.code} at ${issue.pointer}: ${issue.message}`);
        process.exitCode = 1;
    }
    return report.info.version;
}

Promise.all(process.argv.slice(2).map(validate)).then((versions) => {
    console.log(`${versions.length} files of glTF ${versions.join(", ")}`);
}).catch((error) => {
    console.error(error);
    process.exitCode = 1;
});
